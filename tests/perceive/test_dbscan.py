"""DBSCAN against its definition and against scikit-learn."""

import numpy as np
import pytest

from pipeline.perceive.dbscan import dbscan


def textbook(points, eps, min_points):
    """Core points and their connected components, straight from the definition."""
    near = np.linalg.norm(points[:, None] - points[None], axis=2) <= eps
    core = near.sum(axis=1) >= min_points
    component = np.full(len(points), -1)
    for seed in np.flatnonzero(core):
        if component[seed] < 0:
            component[seed] = seed
            front = [seed]
            while front:
                reached = np.flatnonzero(near[front.pop()] & core & (component < 0))
                component[reached] = seed
                front += reached.tolist()
    return near, core, component


def same_partition(a, b):
    return len(set(zip(a.tolist(), b.tolist(), strict=True))) == len(set(a.tolist())) == len(set(b.tolist()))


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("seed", range(6))
def test_clusters_are_those_of_the_definition(dimensions, seed):
    rng = np.random.default_rng(seed)
    blobs = [
        rng.normal(rng.uniform(-8, 8, dimensions), rng.uniform(0.2, 0.8), (60, dimensions)) for _ in range(5)
    ]
    points = np.concatenate([*blobs, rng.uniform(-10, 10, (60, dimensions))])
    label = dbscan(points, 0.6, 5)
    near, core, component = textbook(points, 0.6, 5)
    assert same_partition(label[core], component[core])
    reachable = (near & core).any(axis=1)
    assert np.array_equal(label >= 0, reachable)
    for border in np.flatnonzero(reachable & ~core):
        distance = np.where(core, np.linalg.norm(points - points[border], axis=1), np.inf)
        assert label[border] == label[np.argmin(distance)]


def test_the_order_of_points_does_not_matter():
    rng = np.random.default_rng(1)
    points = rng.normal(0, 2, (500, 3))
    shuffle = rng.permutation(len(points))
    assert same_partition(dbscan(points, 0.5, 4)[shuffle], dbscan(points[shuffle], 0.5, 4))


def test_core_points_agree_with_scikit_learn_at_the_size_of_a_sweep():
    from sklearn.cluster import DBSCAN

    rng = np.random.default_rng(2)
    points = np.concatenate(
        [rng.normal(rng.uniform(-50, 50, 3) * [1, 1, 0.05], 0.5, (100, 3)) for _ in range(60)]
    )
    theirs = DBSCAN(eps=0.7, min_samples=8).fit_predict(points)
    ours = dbscan(points, 0.7, 8)
    assert np.array_equal(ours < 0, theirs < 0)
    assert np.mean(ours[ours >= 0] != theirs[ours >= 0]) < 0.02 or same_partition(ours, theirs)


def test_no_points_and_lone_points_make_no_cluster():
    assert dbscan(np.zeros((0, 3)), 1.0, 2).shape == (0,)
    assert dbscan(np.array([[0.0, 0, 0], [5, 0, 0]]), 1.0, 2).tolist() == [-1, -1]
    assert dbscan(np.array([[0.0, 0, 0], [1, 0, 0]]), 1.0, 2).tolist() == [0, 0]  # eps itself is near


def test_points_kilometres_astray_change_no_cluster():
    points = np.random.default_rng(5).uniform(0, 20, (600, 3))
    astray = np.array([[1e9, 0, 0], [0, -1e9, 0], [0, 0, 1e9]])
    found = dbscan(np.concatenate([points, astray]), 1.2, 4)
    assert found.max() > 0
    np.testing.assert_array_equal(found, [*dbscan(points, 1.2, 4), -1, -1, -1])

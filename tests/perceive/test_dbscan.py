"""DBSCAN against its definition."""

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
    pairs = set(zip(label[core].tolist(), component[core].tolist(), strict=True))
    assert len(pairs) == len(set(label[core])) == len(set(component[core]))
    reachable = (near & core).any(axis=1)
    assert np.array_equal(label >= 0, reachable)
    for border in np.flatnonzero(reachable & ~core):
        distance = np.where(core, np.linalg.norm(points - points[border], axis=1), np.inf)
        assert label[border] == label[np.argmin(distance)]


def test_points_kilometres_astray_change_no_cluster():
    points = np.random.default_rng(5).uniform(0, 20, (600, 3))
    astray = np.array([[1e9, 0, 0], [0, -1e9, 0], [0, 0, 1e9]])
    found = dbscan(np.concatenate([points, astray]), 1.2, 4)
    assert found.max() > 0
    np.testing.assert_array_equal(found, [*dbscan(points, 1.2, 4), -1, -1, -1])

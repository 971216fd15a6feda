"""Object clusters and the uniform sample."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.perceive.lidar import cluster_boxes, cluster_objects, sample_uniformly


def scene(seed, ranges=(8.0, 20.0, 40.0)):
    """Rears of cars at some ranges, denser when near; each 5 m to the left of the last."""
    rng, parts, truth = np.random.default_rng(seed), [], []
    for k, r in enumerate(ranges):
        count = int(4000 / r)
        parts.append(rng.uniform([r, 5 * k - 1, -1.5], [r + 0.3, 5 * k + 1, 0.0], (count, 3)))
        truth += [k] * count
    return np.concatenate(parts).astype(np.float32), np.array(truth)


def clusters(points, ground=False):
    return cluster_objects(points, np.broadcast_to(ground, len(points)).copy(), 0.7, 8)


def test_each_object_is_one_cluster_numbered_by_size_in_a_box_that_holds_it():
    points, truth = scene(0)
    label = clusters(points)
    assert len({(int(a), int(b)) for a, b in zip(truth, label, strict=True) if b >= 0}) == 3
    assert np.mean(label >= 0) > 0.98
    assert np.all(np.diff(np.bincount(label[label >= 0])) <= 0)
    boxes = cluster_boxes(points, label)
    for k in range(3):
        own = points[label == k]
        assert np.array_equal(boxes.min_m[k], own.min(axis=0))
        assert np.array_equal(boxes.max_m[k], own.max(axis=0))
        assert boxes.centre_m[k] == pytest.approx(own.astype(float).mean(axis=0), abs=1e-4)


def row_of(x, half_width, step, z):
    y = np.arange(-half_width, half_width, step)
    return np.stack([np.full_like(y, x), y, np.full_like(y, z)], 1).astype(np.float32)


@pytest.mark.parametrize(
    ("rows", "labels"),
    [
        # 2 deg between rings: 1.05 m apart in height at 30 m, more than eps.
        ([row_of(30.0, 1, 0.1, z) for z in (-1.2, -0.15)], {0}),
        # 0.3 deg between beams: 0.3 m at 60 m, where eps alone reaches two neighbours on either side.
        ([row_of(60.0, 1.6, 0.3, -0.2)], {0}),
        ([row_of(10.0, 1.6, 0.3, -0.2)], {-1}),  # near, it would be denser
    ],
    ids=["two far rings", "far truck", "near scatter"],
)
def test_how_near_the_points_of_an_object_are_depends_on_its_range(rows, labels):
    assert set(clusters(np.concatenate(rows)).tolist()) == labels


def test_ground_and_the_own_vehicle_belong_to_no_object():
    points, _ = scene(1)
    own = np.random.default_rng(2).uniform(-1, 1, (200, 3)).astype(np.float32)
    ground = np.append(np.arange(len(points)) % 3 == 0, np.zeros(200, bool))
    label = clusters(np.concatenate([points, own]), ground)
    assert np.all(label[ground] == -1)
    assert np.all(label[len(points) :] == -1)
    assert cluster_boxes(own, label[len(points) :]).centre_m.shape == (0, 3)
    assert clusters(np.zeros((0, 3), np.float32)).shape == (0,)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), voxel=st.floats(0.1, 2.0), count=st.integers(0, 400))
def test_the_sample_holds_one_measured_point_per_occupied_voxel(seed, voxel, count):
    points = np.random.default_rng(seed).uniform(-5, 5, (count, 3)).astype(np.float32)
    rows = sample_uniformly(points, voxel)
    outside = np.linalg.norm(points, axis=1) > 2.5
    cells = np.floor(points.astype(float) / voxel)
    assert len(np.unique(rows)) == len(rows)
    assert outside[rows].all()
    assert len(np.unique(cells[rows], axis=0)) == len(rows) == len(np.unique(cells[outside], axis=0))
    for row in rows:  # the nearest to the mean of its voxel
        inside = points[outside & (cells == cells[row]).all(axis=1)].astype(float)
        far = np.linalg.norm(inside - inside.mean(axis=0), axis=1)
        assert np.linalg.norm(points[row] - inside.mean(axis=0)) == pytest.approx(far.min())

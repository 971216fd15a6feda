"""Object clusters and the uniform sample."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.perceive.lidar import cluster_boxes, cluster_objects, sample_uniformly


def scene(rng, ranges=(8.0, 20.0, 40.0)):
    """Rears of cars at some ranges, denser when near; each 5 m to the left of the last."""
    parts, truth = [], []
    for k, r in enumerate(ranges):
        count = int(4000 / r)
        parts.append(rng.uniform([r, 5 * k - 1, -1.5], [r + 0.3, 5 * k + 1, 0.0], (count, 3)))
        truth += [k] * count
    return np.concatenate(parts).astype(np.float32), np.array(truth)


def test_each_object_is_one_cluster_at_every_range():
    points, truth = scene(np.random.default_rng(0))
    label = cluster_objects(points, np.zeros(len(points), bool), 0.7, 8)
    assert len({(int(a), int(b)) for a, b in zip(truth, label, strict=True) if b >= 0}) == 3
    assert np.mean(label >= 0) > 0.98


def test_an_object_of_two_far_rings_stays_one_cluster():
    # 2 deg between rings: 1.05 m apart in height at 30 m, more than eps.
    y = np.arange(-1, 1, 0.1)
    rings = [np.stack([np.full_like(y, 30.0), y, np.full_like(y, z)], 1) for z in (-1.2, -0.15)]
    label = cluster_objects(np.concatenate(rings).astype(np.float32), np.zeros(40, bool), 0.7, 8)
    assert set(label.tolist()) == {0}


def test_the_few_points_of_a_far_truck_are_still_an_object():
    # 0.3 deg between beams: 0.3 m at 60 m, where eps alone reaches two neighbours on either side.
    y = np.arange(-1.6, 1.6, 0.3)
    truck = np.stack([np.full_like(y, 60.0), y, np.full_like(y, -0.2)], 1).astype(np.float32)
    assert set(cluster_objects(truck, np.zeros(len(y), bool), 0.7, 8).tolist()) == {0}
    near = truck - np.array([50, 0, 0], np.float32)
    assert set(cluster_objects(near, np.zeros(len(y), bool), 0.7, 8).tolist()) == {
        -1
    }  # near, it would be denser


def test_ground_and_the_own_vehicle_belong_to_no_object():
    points, _ = scene(np.random.default_rng(1))
    ground = np.arange(len(points)) % 3 == 0
    own = np.random.default_rng(2).uniform(-1, 1, (200, 3)).astype(np.float32)
    label = cluster_objects(np.concatenate([points, own]), np.append(ground, np.zeros(200, bool)), 0.7, 8)
    assert np.all(label[: len(points)][ground] == -1)
    assert np.all(label[len(points) :] == -1)


def test_clusters_are_numbered_by_size_and_their_boxes_hold_their_points():
    points, _ = scene(np.random.default_rng(3))
    label = cluster_objects(points, np.zeros(len(points), bool), 0.7, 8)
    sizes = np.bincount(label[label >= 0])
    assert np.all(np.diff(sizes) <= 0)
    boxes = cluster_boxes(points, label)
    for k in range(len(sizes)):
        own = points[label == k]
        assert np.array_equal(boxes.min_m[k], own.min(axis=0))
        assert np.array_equal(boxes.max_m[k], own.max(axis=0))
        assert boxes.centre_m[k] == pytest.approx(own.astype(float).mean(axis=0), abs=1e-4)


def test_no_cluster_gives_no_box():
    assert cluster_boxes(np.zeros((3, 3), np.float32), np.full(3, -1, np.int32)).centre_m.shape == (0, 3)
    assert cluster_objects(np.zeros((0, 3), np.float32), np.zeros(0, bool), 0.7, 8).shape == (0,)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), voxel=st.floats(0.1, 2.0), count=st.integers(0, 400))
def test_the_sample_holds_one_measured_point_per_occupied_voxel(seed, voxel, count):
    points = np.random.default_rng(seed).uniform(-30, 30, (count, 3)).astype(np.float32)
    rows = sample_uniformly(points, voxel)
    outside = np.linalg.norm(points, axis=1) > 2.5
    cells = np.floor(points.astype(float) / voxel)
    assert len(np.unique(rows)) == len(rows)
    assert outside[rows].all()
    assert len(np.unique(cells[rows], axis=0)) == len(rows) == len(np.unique(cells[outside], axis=0))


def test_sampling_evens_out_the_density():
    rng = np.random.default_rng(5)
    near, far = (
        rng.uniform([4, -2, 0], [8, 2, 0.01], (20000, 3)),
        rng.uniform([40, -2, 0], [44, 2, 0.01], (400, 3)),
    )
    rows = sample_uniformly(np.concatenate([near, far]).astype(np.float32), 0.25)
    assert np.sum(rows < 20000) / np.sum(rows >= 20000) < 2

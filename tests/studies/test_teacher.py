"""What a segmenter is worth is counted where both labellings speak, and judged by points that it never saw."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.se3 import inverse, transform_points
from pipeline.learn.infer.onnx_networks import SHIPPED
from pipeline.learn.infer.single_frame import SingleFrameCalibrator
from pipeline.learn.sample.grid import Grid, grid_rays
from schemas.training import GRID_CLASSES, UNKNOWN_CLASS
from tests.benchmarks.studies import ssl_teacher
from tests.makers.solve_scenes import T_CAMERA_LIDAR, make_day

ROAD, FENCE = GRID_CLASSES.index("road"), GRID_CLASSES.index("fence")


def test_labellings_are_compared_where_both_know_a_class():
    a = np.array([[ROAD, ROAD, FENCE, UNKNOWN_CLASS, ROAD]])
    b = np.array([[ROAD, FENCE, FENCE, FENCE, UNKNOWN_CLASS]])
    told = ssl_teacher.agreement([(a, b)])
    assert told == {"equal": 0.667, "mean_iou": 0.5, "road": 0.5, "fence": 0.5}


def test_the_lidar_tells_ground_from_what_stands_whatever_the_labels_say():
    grid, row = Grid(), make_day(1, seed=1)[0]
    rays = grid_rays(grid)[[20, 20, 80, 80], [30, 60, 60, 90]]
    inside = transform_points(
        inverse(T_CAMERA_LIDAR), np.vstack([20.0 * rays, -20.0 * rays[:1], 90.0 * rays[:1]])
    )
    row = replace(
        row,
        lidar_map_xyz_m=inside.astype(np.float32),
        lidar_map_is_ground=np.array([0, 1, 1, 1, 1, 1], np.uint8),
        lidar_map_cluster=np.array([3, -1, -1, -1, -1, -1], np.int32),
    )
    classes = np.full((grid.height, grid.width), FENCE)
    classes[60:] = ROAD
    classes[80, 90] = UNKNOWN_CLASS
    found = ssl_teacher.judged_by_lidar(classes, row, T_CAMERA_LIDAR, grid)
    # Ground on road, ground on fence; nothing standing on road, one on fence. The others: unknown, behind, too far.
    assert found.tolist() == [[1, 1], [0, 1]]


def test_a_linear_probe_finds_classes_that_features_separate():
    rng = np.random.default_rng(3)
    classes = rng.integers(0, len(GRID_CLASSES), (16, 24))
    features = np.eye(len(GRID_CLASSES), dtype=np.float32)[classes].transpose(2, 0, 1)
    noisy = np.concatenate([features, rng.normal(size=(2, 16, 24)).astype(np.float32)])
    known = np.where(rng.random(classes.shape) < 0.2, UNKNOWN_CLASS, classes)
    weights = ssl_teacher.linear_probe([noisy], [known])
    assert (ssl_teacher.probed(weights, noisy) == classes).all()


@pytest.mark.parametrize("name", ["joint", "joint_classes"])
def test_encoders_of_the_shipped_networks_are_cut_out_before_their_classes_are_normalised(name):
    grid, channels = Grid(), SingleFrameCalibrator(SHIPPED / f"{name}.onnx").config.camera_channels
    found = ssl_teacher.encoder_of(SHIPPED / f"{name}.onnx")(np.ones((1, channels, grid.height, grid.width)))
    assert found.shape == (len(GRID_CLASSES), grid.height, grid.width)
    assert np.abs(np.exp(found).sum(0) - 1).max() > 0.1  # no probabilities yet

"""The paper's signs of misalignment: quiet at the truth, loud when a sensor turns."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.paper.triggers import exceeded, trigger_metrics
from pipeline.core.config import TriggerConfig
from pipeline.rig.se3 import exp_so3
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day


@pytest.fixture(scope="module")
def day():
    return [with_ages(o, 3) for o in make_day(10)]


def with_ages(observation, age):
    n = len(observation.radar_track_xyz_m)
    return replace(observation, radar_track_age=np.full(n, age, np.int32))


def transforms(camera_lidar=T_CAMERA_LIDAR, lidar_radar=T_LIDAR_RADAR):
    return {
        "camera_lidar": camera_lidar,
        "camera_radar": camera_lidar @ lidar_radar,
        "lidar_radar": lidar_radar,
    }


def turned(T, axis, angle_deg):
    T = T.copy()
    T[:3, :3] = exp_so3(np.radians(angle_deg) * np.eye(3)[axis]) @ T[:3, :3]
    return T


def test_nothing_fires_at_the_truth(day):
    metrics = trigger_metrics(day, transforms())
    config = TriggerConfig(
        lidar_outside_fraction=0.03, drivable_outside_fraction=0.25
    )  # half-size labels, ragged cells
    assert {pair: exceeded(m, config) for pair, m in metrics.items()} == {p: [] for p in metrics}


def test_a_turned_camera_fires_both_of_its_pairs_and_not_lidar_radar(day):
    metrics = trigger_metrics(day, transforms(camera_lidar=turned(T_CAMERA_LIDAR, 1, 5)))
    assert exceeded(metrics["camera_lidar"], TriggerConfig()) == ["lidar_outside_fraction"]
    assert exceeded(metrics["camera_radar"], TriggerConfig()) == ["radar_outside_image"]
    assert metrics["lidar_radar"] == trigger_metrics(day, transforms())["lidar_radar"]


def test_a_turned_radar_fires_lidar_radar_by_both_metrics(day):
    metrics = trigger_metrics(day, transforms(lidar_radar=turned(T_LIDAR_RADAR, 2, 8)))["lidar_radar"]
    assert exceeded(metrics, TriggerConfig()) == ["radar_outside_lidar", "drivable_outside_fraction"]
    assert metrics["radar_outside_lidar"] > 3


def test_a_metric_that_no_frame_can_show_is_left_out(day):
    empty = [with_ages(replace(o, radar_track_xyz_m=np.zeros((0, 3), np.float32)), 3) for o in day]
    for quiet in (empty, [with_ages(o, 1) for o in day]):  # clusters of one scan are not tracked yet
        metrics = trigger_metrics(quiet, transforms())
        assert metrics["camera_radar"] == {}
        assert list(metrics["lidar_radar"]) == ["drivable_outside_fraction"]
        assert exceeded(metrics["camera_radar"], TriggerConfig()) == []

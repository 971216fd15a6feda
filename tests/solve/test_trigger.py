"""The paper's signs of misalignment: quiet at the truth, loud when a sensor turns."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.config import TriggerConfig
from pipeline.geometry.se3 import exp_so3
from pipeline.solve.trigger import exceeded, trigger_metrics
from tests.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day


@pytest.fixture(scope="module")
def day():
    return make_day(10)


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


def test_counts_are_per_frame_whatever_the_number_of_frames(day):
    once = trigger_metrics(day, transforms(lidar_radar=turned(T_LIDAR_RADAR, 2, 8)))["lidar_radar"]
    twice = trigger_metrics([*day, *day], transforms(lidar_radar=turned(T_LIDAR_RADAR, 2, 8)))["lidar_radar"]
    assert once == pytest.approx(twice)


def test_a_metric_that_no_frame_can_show_is_left_out(day):
    empty = [replace(o, radar_track_xyz_m=np.zeros((0, 3), np.float32)) for o in day]
    metrics = trigger_metrics(empty, transforms())
    assert metrics["camera_radar"] == {}
    assert list(metrics["lidar_radar"]) == ["drivable_outside_fraction"]
    assert exceeded(metrics["camera_radar"], TriggerConfig()) == []

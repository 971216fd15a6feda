"""Radar velocities that no odometry explains: convoys taken for the ground, and turns that nobody measured."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.calibrate.joint.lidar_radar.radar_velocity import contradicts_odometry, turns_unmeasured
from pipeline.core.config import SolveConfig
from pipeline.rig.changes import change_between, change_covariance
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR

LEVER_M = 2.5
MOUNTED_RAD = 0.3  # the radar looks aside


@pytest.fixture(scope="module")
def day():
    """Frames of a car that turns one way and the other, its radar mounted askew."""
    rng = np.random.default_rng(0)
    frames = []
    for k, o in enumerate(street_day(16)):
        rate, speed = 0.4 * np.sin(k), 6.0 + 2 * (k % 5)
        travel = np.array([speed, rate * LEVER_M, 0.0]) + rng.normal(0, 0.05, 3)
        velocity = exp_so3(np.array([0.0, 0.0, -MOUNTED_RAD])) @ travel
        frames.append(replace(o, ego_speed_mps=speed, ego_yaw_rate_radps=rate, radar_velocity_mps=velocity))
    return frames


def spoiled(day, at, change):
    return [replace(o, **change(o)) if k in at else o for k, o in enumerate(day)]


def test_a_car_in_turns_contradicts_nothing(day):
    assert not contradicts_odometry(day).any()
    assert not turns_unmeasured(day).any()
    standing = [replace(o, radar_velocity_mps=np.zeros(3), ego_speed_mps=0.0) for o in day]
    assert not contradicts_odometry(standing).any()


@pytest.mark.parametrize("error", [[-3.0, 0.0, 0.0], [0.0, 2.0, 0.0], [-1.0, -1.0, 0.0]])
def test_frames_whose_velocity_is_a_convoys_are_named(day, error):
    at = {2, 3, 11}
    lied = spoiled(day, at, lambda o: {"radar_velocity_mps": o.radar_velocity_mps + error})
    assert set(np.flatnonzero(contradicts_odometry(lied))) == at


def test_what_the_car_does_not_log_contradicts_nothing(day):
    silent = [
        replace(
            o,
            ego_speed_mps=None,
            ego_yaw_rate_radps=None,
            radar_velocity_mps=o.radar_velocity_mps + [0, 3.0 * (k < 3), 0],
        )
        for k, o in enumerate(day)
    ]
    assert not contradicts_odometry(silent).any()
    assert turns_unmeasured(silent)[:3].all()
    blind = spoiled(silent, {5}, lambda _: {"radar_velocity_mps": None})
    assert not contradicts_odometry(blind).any()
    assert not turns_unmeasured(blind)[5]


@pytest.mark.parametrize(
    "wrong",
    [
        lambda o, _: {"ego_speed_mps": 1.08 * o.ego_speed_mps},  # another tyre
        lambda o, _: {"ego_speed_mps": 3.6 * o.ego_speed_mps},  # km/h
        lambda _, k: {"ego_speed_mps": float(k), "ego_yaw_rate_radps": 0.4 * np.cos(3 * k)},
    ],
)
def test_an_odometry_that_is_itself_wrong_contradicts_no_day(day, wrong):
    assert not contradicts_odometry([replace(o, **wrong(o, k)) for k, o in enumerate(day)]).any()


def test_a_third_of_a_day_in_a_convoy_moves_nothing_and_is_counted():
    """Frames whose radar takes vehicles that pull away for the ground: they agree among themselves, and are wrong."""
    honest = street_day(24)
    frames = []
    for k, o in enumerate(honest):
        aside = o.radar_xyz_m + np.array([0.9, 0.4, 0.0], np.float32)
        wrong = {"radar_xyz_m": aside, "radar_velocity_mps": o.radar_velocity_mps + [-4.0, -3.0, 0.0]}
        measured = replace(o, ego_yaw_rate_radps=0.0)
        frames.append(replace(measured, **wrong) if k % 3 == 0 else measured)
    prior = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.2)
    found = estimate_lidar_radar(frames, prior, SolveConfig(), np.random.default_rng(0))
    assert found.frames_rejected == {"radar velocity contradicts the odometry": 8}
    assert found.frames_used == 16
    error = change_between(T_LIDAR_RADAR, found.T)
    sigma = np.sqrt(np.diag(change_covariance(found.T, found.covariance)))
    assert np.all(np.abs(error) < 3 * sigma)
    assert np.abs(error[3:5]).max() < 0.1

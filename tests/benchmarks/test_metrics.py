"""What the studies report follows from errors and sigmas as it should."""

import json

import numpy as np
import pytest

from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import change_covariance, exp_se3, exp_so3, from_rotation_translation, to_quaternion
from schemas.calibrations import CalibrationRecord
from tests.benchmarks.studies.metrics import measure, within
from tests.benchmarks.studies.run import coverage
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR

PRIOR = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.05)
COVARIANCE = np.diag([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03]) ** 2


def record(T, status="accepted", pair="camera_lidar") -> CalibrationRecord:
    q, t = to_quaternion(T), T[:3, 3]
    return CalibrationRecord(
        vehicle="v", day="2026-03-02", method="joint", pair=pair, parent_frame="camera", child_frame="lidar",
        status=status, reason="", work_key="key", code_version="1", seed=0,
        qw=q[0], qx=q[1], qy=q[2], qz=q[3], tx_m=t[0], ty_m=t[1], tz_m=t[2],
        covariance=COVARIANCE, observability=[1.0] * 6, observable=[True] * 5 + [False],
        time_offset_s=0.01, time_offset_sigma_s=0.002, diagnostics={"halves_m": 0.01},
    )  # fmt: skip


def test_a_perfect_result_has_no_error_and_survives_json():
    measured = measure(record(T_CAMERA_LIDAR), T_CAMERA_LIDAR, PRIOR, 0.012)
    assert np.abs(measured["error"]).max() < 1e-9
    assert measured["az_deg"] < 1e-6
    assert json.loads(json.dumps(measured)) == measured


def test_the_error_of_a_turn_is_that_turn_whatever_the_lever_arm():
    turn = np.array([0.01, -0.02, 0.005])
    T = from_rotation_translation(exp_so3(turn) @ T_CAMERA_LIDAR[:3, :3], T_CAMERA_LIDAR[:3, 3])
    measured = measure(record(T), T_CAMERA_LIDAR, PRIOR, None)
    assert measured["error"] == pytest.approx([*turn, 0, 0, 0], abs=1e-6)


def test_errors_drawn_from_the_covariance_are_one_sigma_large():
    rng = np.random.default_rng(0)
    z = []
    for xi in rng.multivariate_normal(np.zeros(6), COVARIANCE, 300):
        measured = measure(record(exp_se3(xi) @ T_CAMERA_LIDAR), T_CAMERA_LIDAR, PRIOR, None)
        z.append(np.array(measured["error"]) / measured["sigma"])
    assert np.sqrt(np.mean(np.square(z), axis=0)) == pytest.approx(np.ones(6), abs=0.15)
    assert measured["sigma"] == pytest.approx(
        np.sqrt(np.diag(change_covariance(T_CAMERA_LIDAR, COVARIANCE))), rel=0.02
    )


def test_limits_ask_of_all_angles_or_only_of_those_that_are_claimed():
    measured = {"az_deg": 0.1, "el_deg": 0.5, "observable": [0, 1, 1, 1, 1, 1]}
    assert not within("camera_lidar", measured)
    assert within("camera_lidar", measured, claimed=True)


def test_the_coverage_table_counts_what_lies_beyond_three_sigma():
    far = measure(
        record(exp_se3(np.array([0, 0, 0, 0.05, 0, 0])) @ T_CAMERA_LIDAR), T_CAMERA_LIDAR, PRIOR, 0.012
    )
    result = {"day": {"seed": 7, "environment": "urban"}, "pairs": {"camera_lidar": far}}
    text = coverage([result])
    assert "| day | camera_lidar | tx | 1 | 0.050 m | 0.010 m | 4" in text
    assert "| prior | camera_lidar | tz | 1 | 0.000 m |" in text

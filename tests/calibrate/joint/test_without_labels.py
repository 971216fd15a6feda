"""Camera-lidar of a camera without semantics: the truth within the sigma, and nothing wrong from a start far off."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.verify.constancy import MOVED_SIGMAS, PART_FLOOR_RAD
from pipeline.core.config import SolveConfig
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse, log_so3, perturb_exactly
from tests.makers.camera_lidar import estimate_camera_lidar
from tests.makers.traced_scenes import DENSE, SPARSE, T_TRUE, traced_day, without_labels


def found_from(day, degrees, seed):
    T = perturb_exactly(T_TRUE, np.radians(degrees), 0.05, np.random.default_rng(seed))
    prior = Prior(T, np.eye(4), float(np.radians(2.0)), 0.05)
    return estimate_camera_lidar(day, prior, SolveConfig(), np.random.default_rng(0))


def error_and_sigma_deg(found):
    turn = log_so3((found.T @ inverse(T_TRUE))[:3, :3])
    return np.degrees(turn), np.degrees(np.sqrt(np.diag(found.covariance))[:3])


@pytest.mark.parametrize(
    ("rig", "frames"),
    [(SPARSE, 16), pytest.param(DENSE, 8, marks=pytest.mark.slow)],
    ids=["16 rings", "dense"],
)
def test_a_day_without_labels_shows_the_pose_within_its_sigma(rig, frames):
    found = found_from(without_labels(traced_day(rig, frames, seed=1)), 2.0, 0)
    error, sigma = error_and_sigma_deg(found)
    assert np.abs(error).max() < 0.35
    assert (np.abs(error) < 3 * sigma).all()
    assert not found.disproved


@pytest.mark.slow
def test_a_camera_that_turns_at_noon_is_seen_to_move_without_labels_too():
    turned = replace(SPARSE, T_camera_lidar=from_rotation_translation(
        exp_so3(np.radians([0.0, 1.0, 0.0])) @ T_TRUE[:3, :3], T_TRUE[:3, 3]
    ))  # fmt: skip
    morning, noon = traced_day(SPARSE, 16, seed=1), traced_day(turned, 16, seed=2)
    late = [replace(o, stamp_ns=o.stamp_ns + 10**12, camera_stamp_ns=o.camera_stamp_ns + 10**12, drive=o.drive + 9)
            for o in noon]  # fmt: skip
    found = found_from(without_labels([*morning, *late]), 1.0, 0)
    assert np.abs(found.parts.sigmas(PART_FLOOR_RAD)).max() > MOVED_SIGMAS
    still = found_from(without_labels([*morning, *traced_day(SPARSE, 16, seed=2)]), 1.0, 0)
    assert still.parts is None or np.abs(still.parts.sigmas(PART_FLOOR_RAD)).max() < MOVED_SIGMAS

"""A search on held-out frames: where these are more than the fit had, they find a place that the result missed."""

import numpy as np
import pytest

from pipeline.calibrate.verify.held_out import found_elsewhere, held_out_place
from pipeline.calibrate.verify.held_out_score import held_out_score
from pipeline.calibrate.verify.target_accuracy import claims_of
from pipeline.core.config import SolveConfig
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation, log_so3
from pipeline.rig.targets import DEFAULT_TARGETS
from tests.makers.solve_scenes import T_LIDAR_RADAR
from tests.makers.traced_scenes import DENSE, T_TRUE, traced_day

SIGMA = np.array([*np.radians([0.05] * 3), 0.02, 0.02, 0.02])
PRIOR = Prior(T_TRUE, T_LIDAR_RADAR, float(np.radians(2.0)), 0.05)


@pytest.fixture(scope="module")
def held_out():
    return traced_day(DENSE, 10, seed=7)


@pytest.fixture(scope="module")
def place(held_out):
    return held_out_place(held_out, PRIOR, SolveConfig())


def said_of(T, held_out, place):
    seen = np.ones(6, bool)
    result = PairEstimate(
        "camera_lidar", T, np.diag(SIGMA**2), seen.astype(float), seen, 5, time_offset_s=0.0,
        time_offset_sigma_s=0.003,
    )  # fmt: skip
    score = held_out_score(result, held_out, PRIOR, SolveConfig())
    claims = claims_of("camera_lidar", T, result.covariance, None, float(np.radians(0.2)), 0.995)
    blocks = np.arange(len(held_out))
    sigma_rad = np.array([claims[name].sigma_rad for name in ("azimuth", "elevation")])
    return found_elsewhere(result, place, score.cost, sigma_rad, blocks, DEFAULT_TARGETS, 2.33)


def turned(axis, degrees):
    turn = exp_so3(np.radians(degrees) * np.eye(3)[axis])
    return from_rotation_translation(turn @ T_TRUE[:3, :3], T_TRUE[:3, 3])


def test_a_right_result_is_where_the_held_out_frames_are(held_out, place):
    assert np.degrees(np.linalg.norm(log_so3(place[:3, :3] @ T_TRUE[:3, :3].T))) < 0.3
    assert said_of(T_TRUE, held_out, place) == []
    assert said_of(turned(1, 0.1), held_out, place) == []  # two sigmas


@pytest.mark.parametrize(("axis", "direction"), [(0, "elevation"), (1, "azimuth")])
def test_a_result_in_another_place_is_disproved_with_how_far_it_is_off(axis, direction, held_out, place):
    (check,) = said_of(turned(axis, 1.5), held_out, place)
    assert check.disproves
    off_deg = float(check.sentence.split(f" deg in {direction}")[0].split()[-1])
    assert off_deg == pytest.approx(1.5, abs=0.2)
    assert np.degrees(np.linalg.norm(check.error[:3])) == pytest.approx(1.5, abs=0.3)


def test_frames_that_show_nothing_have_no_place(held_out):
    assert held_out_place(held_out[:2], PRIOR, SolveConfig()) is None

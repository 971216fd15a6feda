"""The camera's time offset where other cars drive: what is unsure by what the halves of the image say."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.observability import IS_TZ
from pipeline.calibrate.joint.camera_lidar.profiles import (
    DT,
    TimeOffsetProfile,
    left_out_in_time,
    profile_time_offset,
)
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, Scored
from pipeline.core.config import SolveConfig
from pipeline.objective.camera_lidar.score import KernelSettings, prepare_terms
from pipeline.rig.estimates import Prior
from tests.makers.camera_lidar import estimate_camera_lidar
from tests.makers.traced_scenes import DENSE, T_TRUE, traced_day

STATE = AlignmentState(T_TRUE)
SPEED_MPS = 20.0
PRIOR = Prior(T_TRUE, np.eye(4), float(np.radians(0.2)), 0.05)


@pytest.fixture(scope="module")
def terms():
    """Scenes that the car passes at one speed, images with their sweeps; none of the objects moves."""
    day = traced_day(DENSE, 12, seed=2)
    return prepare_terms(day, T_TRUE, np.array([[SPEED_MPS, 0.0, 0.0]] * len(day)), reach_rad=0.03)


@pytest.fixture(scope="module")
def kernel(terms):
    return terms.fitted(STATE.alone, KernelSettings.wide(1.5, 2), np.random.default_rng(0))


def profile_of(terms, kernel):
    scored = Scored(terms, kernel, PRIOR, SolveConfig())
    return profile_time_offset(scored, STATE, IS_TZ, np.arange(terms.frames))


def with_traffic(terms, left_m, right_m):
    """What is seen on either half of the image has moved by so much between its point and the image."""
    xyz = terms.edges.xyz_m
    is_left = xyz[:, 1] > 0
    moved = xyz.copy()
    moved[:, 0] += np.where(is_left, left_m, right_m)
    return replace(terms, edges=replace(terms.edges, xyz_m=moved))


def unsure_s(profile):
    return float(np.linalg.norm(left_out_in_time(profile, IS_TZ)[:, DT]))


def test_oncoming_cars_on_one_half_of_the_image_make_the_time_offset_unsure_by_what_they_draw_it(
    terms, kernel
):
    assert unsure_s(profile_of(terms, kernel)) < 0.008
    way_m = 1.0  # of a car that drives towards us, in a twentieth of a second
    for left_m in (way_m, -way_m):
        profile = profile_of(with_traffic(terms, left_m, 0.0), kernel)
        off_s = abs(profile.state.dt_s)
        assert unsure_s(profile) > 0.5 * max(off_s, 0.5 * way_m / SPEED_MPS)
        assert np.sqrt(profile.variance_s2) < 0.5 * unsure_s(profile)  # frames do not show it


def test_a_time_offset_without_a_half_is_where_its_own_profile_has_it(terms, kernel):
    mixed = with_traffic(terms, 0.8, 0.0)
    rows = left_out_in_time(profile_of(mixed, kernel), IS_TZ)
    whole = profile_of(mixed, kernel).state.dt_s
    is_right = mixed.edges.xyz_m @ T_TRUE[0, :3] + T_TRUE[0, 3] > 0
    for k, rest in enumerate((~is_right, is_right)):
        half = replace(mixed, edges=mixed.edges.chosen(rest))
        said = rows[k, DT] / np.sqrt(1 - 1 / 2)
        assert said == pytest.approx(profile_of(half, kernel).state.dt_s - whole, abs=0.012)  # a step


@pytest.mark.slow
def test_a_day_of_oncoming_traffic_states_a_time_offset_near_what_is_expected_that_its_sigma_covers():
    day = []
    for o in traced_day(DENSE, 12, seed=3):
        xyz = o.lidar_edge_xyz_m.copy()
        xyz[xyz[:, 1] > 0, 0] += 1.0
        day.append(replace(o, ego_speed_mps=SPEED_MPS, lidar_edge_xyz_m=xyz))
    prior = Prior(T_TRUE, np.eye(4), float(np.radians(1.0)), 0.05)
    expected, vague = (
        estimate_camera_lidar(day, prior, SolveConfig(time_offset_sigma_s=s), np.random.default_rng(0))
        for s in (0.05, 0.2)
    )
    assert 0.02 < abs(expected.time_offset_s) < 2 * expected.time_offset_sigma_s
    assert expected.diagnostics["left_out_dt_s"] > 0.5 * abs(expected.time_offset_s)
    # The less is told by the day, the more counts what is expected: no offset.
    assert abs(expected.time_offset_s) < 0.95 * abs(vague.time_offset_s)


def test_what_is_at_the_prior_stays_there_and_a_profile_without_ends_says_nothing(terms, kernel):
    profile = profile_of(with_traffic(terms, 0.8, 0.0), kernel)
    fixed = np.isin(np.arange(8), (1, 5))
    rows = left_out_in_time(profile, fixed)
    assert np.all(rows[:, fixed] == 0)
    assert np.abs(rows[:, [0, DT]]).max(axis=0).min() > 0
    assert left_out_in_time(TimeOffsetProfile(STATE, 1e-6, 0.0), IS_TZ).shape == (0, 8)

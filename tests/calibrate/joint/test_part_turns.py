"""Parts of a camera-lidar day against each other: sides of the edges and paint, halves of the image and its clock."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar import part_turns as parts
from pipeline.calibrate.joint.camera_lidar.observability import IS_TZ
from pipeline.calibrate.joint.camera_lidar.part_turns import box_offsets, disagreement
from pipeline.calibrate.joint.camera_lidar.profiles import (
    DT,
    TimeOffsetProfile,
    left_out_in_time,
    profile_time_offset,
)
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, Scored
from pipeline.calibrate.numerics.nuisances import PartTurn
from pipeline.core.config import SolveConfig
from pipeline.objective.camera_lidar.score import KernelSettings, prepare_terms
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from schemas.observations import EDGE_BELOW
from tests.makers.camera_lidar import estimate_camera_lidar, prior_off_by, turn_and_sigma_deg
from tests.makers.solve_scenes import T_CAMERA_LIDAR, make_day
from tests.makers.traced_scenes import DENSE, GROUND_M, T_TRUE, traced_day

ROOF_M = GROUND_M + 1.6  # of the cars


def with_windows(day, depth_rad=0.02, sills=3, within_m=np.inf):
    """Beams go through rear windows: their sills are edges above a foreground, and no label ends there.

    Cars further off than `within_m` are of a kind without windows.
    """
    out = []
    for o in day:
        xyz, side = o.lidar_edge_xyz_m, o.lidar_edge_side
        is_roof = (side == EDGE_BELOW) & (np.abs(xyz[:, 2] - ROOF_M) < 0.2)
        roof = np.flatnonzero(is_roof & (xyz[:, 0] < within_m))
        more = np.repeat(roof, sills)
        changed = {
            name: np.concatenate([getattr(o, name), getattr(o, name)[more]])
            for name in (
                "lidar_edge_side", "lidar_edge_jump_m", "lidar_edge_gap_rad", "lidar_edge_points"
            )
        }  # fmt: skip
        sill = xyz[more] - np.linalg.norm(xyz[more], axis=1, keepdims=True) * np.float32([0, 0, depth_rad])
        out.append(replace(o, lidar_edge_xyz_m=np.concatenate([xyz, sill]), **changed))
    return out


@pytest.fixture(scope="module")
def day():
    return traced_day(DENSE, 12, seed=1)


def test_cars_with_windows_are_held(day):
    found = estimate_camera_lidar(with_windows(day), prior_off_by(0.5, 0.02))
    (check,) = found.failed_checks
    assert check.fault == "witnesses_disagree"
    assert "on pitch" in check.sentence
    assert "edges above a foreground" in check.sentence
    assert np.degrees(np.abs(check.error[0])) > 0.4  # where the sills are right
    assert not any(check.error[1:])


@pytest.mark.slow
@pytest.mark.parametrize(("within_m", "faults"), [(0.0, []), (18.0, ["witnesses_disagree"])])
def test_windows_in_cars_of_one_kind_only_are_seen_where_no_paint_tells(within_m, faults):
    day = traced_day(DENSE, 12, seed=1, reflective=False)
    found = estimate_camera_lidar(with_windows(day, sills=2, within_m=within_m), prior_off_by(0.5, 0.02))
    assert [check.fault for check in found.failed_checks] == faults
    turn_deg = abs(turn_and_sigma_deg(found)[0][0])
    assert (turn_deg > 0.5) == bool(faults)  # the fit follows the sills
    for check in found.failed_checks:
        assert np.degrees(abs(check.error[0])) > 0.8 * turn_deg
        assert "low edges above a foreground" in check.sentence
        assert "high edges above a foreground" in check.sentence


def witness(name, offset_deg, scatter_deg=0.02, floor_deg=0.1, axis=0):
    return PartTurn(name, *np.radians([offset_deg, scatter_deg, floor_deg]), axis)


def test_two_that_differ_beyond_two_sigmas_are_named_and_the_pose_may_be_off_by_the_larger():
    asked = [witness("a", -0.4), witness("b", 0.8), witness("c", 0.1), witness("d", 3.0, axis=1)]
    (check,) = disagreement(asked)
    assert check.sentence == "the evidence disagrees on pitch: a by -0.40 +- 0.10 deg, b by +0.80 +- 0.10 deg"
    assert check.error == pytest.approx((np.radians(0.8), 0.0, 0.0, 0.0, 0.0, 0.0))
    (check,) = disagreement([witness("a", -0.9, axis=1), witness("b", 0.0, axis=1)])
    assert check.error == pytest.approx((0.0, np.radians(-0.9), 0.0, 0.0, 0.0, 0.0))


def test_differences_within_two_sigmas_or_three_floors_contradict_nothing():
    assert disagreement([witness("a", 0.0, 0.3), witness("b", 1.1, 0.3)])
    assert disagreement([witness("a", 0.0, 0.4), witness("b", 1.1, 0.4)]) == []
    assert disagreement([witness("a", 0.2), witness("b", -0.2)]) == []  # as labels too wide would do
    fit = witness("the fit", 0.0, 0.11, 0.03)
    assert disagreement([fit, witness("boxes", 0.42, 0.04, 0.1)])
    assert disagreement([fit, witness("boxes", 0.30, 0.04, 0.1)]) == []  # .31 deg are three of their floors


@pytest.mark.parametrize("turn_deg", [(1.5, 0.0), (0.0, -1.5)])
def test_boxes_show_by_how_much_a_pose_is_turned(turn_deg):
    day, turn = make_day(12, seed=3), exp_so3(np.radians([*turn_deg, 0.0]))
    poses = (T_CAMERA_LIDAR, from_rotation_translation(turn, np.zeros(3)) @ T_CAMERA_LIDAR)
    straight, turned = (box_offsets(day, np.repeat(T[None], len(day), axis=0)) for T in poses)
    assert set(turned[0].tolist()) == set(range(12))
    medians = [np.degrees(np.median(offset, axis=0)) for _, offset, _ in (straight, turned)]
    assert np.abs(medians[0]).max() < 0.2  # faces that look away are in the box, not in the cloud
    np.testing.assert_allclose(medians[1] - medians[0], -np.array(turn_deg), atol=0.1)


@pytest.mark.parametrize(("way", "axes"), [((10.0, 0.0, 0.0), [0, 1]), ((0.0, 10.0, 0.0), [])])
def test_boxes_of_road_users_that_pass_across_the_view_take_no_part(way, axes):
    day = make_day(16, seed=3)
    poses, ways = np.tile(T_CAMERA_LIDAR[:3].reshape(1, 12), (16, 1)), np.tile(way, (16, 1))
    assert [turn.axis for turn in parts._boxes(day, poses, ways, np.arange(16), 0)] == axes


@pytest.mark.parametrize(("nats", "is_sure"), [(3.0, False), (30.0, True)])
def test_a_part_that_hardly_prefers_its_own_place_does_not_contradict_the_fit(nats, is_sure):
    turn = np.radians(np.linspace(-2.0, 2.0, 41))
    score = np.zeros((41, 20))
    score[0] += nats / 20  # in every frame alike, so that all resamples end there
    offset, sigma = parts._maximum(turn, score, np.arange(20), np.random.default_rng(0))
    assert np.degrees(offset) == pytest.approx(-2.0)
    assert (sigma < abs(offset) / 3) == is_sure


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
    profile = profile_of(mixed, kernel)
    rows, whole = left_out_in_time(profile, IS_TZ), profile.state.dt_s
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
    prior = replace(PRIOR, rotation_sigma_rad=float(np.radians(1.0)))
    expected, vague = (
        estimate_camera_lidar(day, prior, SolveConfig(time_offset_sigma_s=s)) for s in (0.05, 0.2)
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

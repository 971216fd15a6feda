"""Sides of the edges and paint against each other: where they contradict, pitch is held."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar import part_turns as parts
from pipeline.calibrate.joint.camera_lidar.part_turns import box_offsets, disagreement
from pipeline.calibrate.joint.part_turn import PartTurn
from pipeline.core.config import SolveConfig
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse, log_so3, perturb_exactly
from schemas.observations import EDGE_BELOW
from tests.makers.camera_lidar import estimate_camera_lidar
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


def solved(day):
    T = perturb_exactly(T_TRUE, np.radians(0.5), 0.02, np.random.default_rng(0))
    prior = Prior(T, np.eye(4), float(np.radians(2.0)), 0.05)
    return estimate_camera_lidar(day, prior, SolveConfig(), np.random.default_rng(0))


@pytest.fixture(scope="module")
def day():
    return traced_day(DENSE, 12, seed=1)


def test_cars_with_windows_are_held(day):
    found = solved(with_windows(day))
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
    found = solved(with_windows(day, sills=2, within_m=within_m))
    assert [check.fault for check in found.failed_checks] == faults
    turn_deg = np.degrees(abs(log_so3((found.T @ inverse(T_TRUE))[:3, :3])[0]))
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
    medians = [np.degrees(np.median(offset, axis=0)) for _, offset in (straight, turned)]
    assert np.abs(medians[0]).max() < 0.2  # faces that look away are in the box, not in the cloud
    np.testing.assert_allclose(medians[1] - medians[0], -np.array(turn_deg), atol=0.1)


@pytest.mark.parametrize(("nats", "is_sure"), [(3.0, False), (30.0, True)])
def test_a_part_that_hardly_prefers_its_own_place_does_not_contradict_the_fit(nats, is_sure):
    turn = np.radians(np.linspace(-2.0, 2.0, 41))
    score = np.zeros((41, 20))
    score[0] += nats / 20  # in every frame alike, so that all resamples end there
    offset, sigma = parts._maximum(turn, score, np.arange(20), np.random.default_rng(0))
    assert np.degrees(offset) == pytest.approx(-2.0)
    assert (sigma < abs(offset) / 3) == is_sure

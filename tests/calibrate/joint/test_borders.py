"""Errors that all frames share: labels too wide, borders of other things, and a clock a camera slides along."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.borders import border_errors
from pipeline.calibrate.joint.camera_lidar.observability import along_the_way
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, Scored, refine
from pipeline.calibrate.numerics.bias_floors import BORDER_SHARE, EDGE_SIDE_ALONE
from pipeline.core.config import SolveConfig
from pipeline.objective.camera_lidar.label_width import OUTWARD, label_width_px, widened
from pipeline.objective.camera_lidar.score import KernelSettings, prepare_terms
from pipeline.rig.changes import change_between, change_jacobian
from pipeline.rig.estimates import Prior
from schemas.observations import EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT
from tests.makers.traced_scenes import DENSE, T_TRUE, traced_day

STATE = AlignmentState(T_TRUE)
NOT_SOLVED = np.isin(np.arange(8), (5, 6, 7))  # position along the axis, time offset, focal length
VARIANCE = np.array([0.03**2] * 3 + [0.05**2] * 3 + [0.03**2, 0.003**2])


@pytest.fixture(scope="module")
def terms():
    day = traced_day(DENSE, 8, seed=1)
    return prepare_terms(day, T_TRUE, np.zeros((len(day), 3)), reach_rad=0.03)


@pytest.fixture(scope="module")
def kernel(terms):
    return terms.fitted(STATE.alone, KernelSettings.wide(1.5, 2), np.random.default_rng(0))


def chosen(terms, keep):
    return replace(terms, edges=terms.edges.chosen(keep))


def test_widened_edges_lie_in_the_image_as_far_outward_as_the_labels_are_wide(terms):
    def pixels(some):
        q = some.edges.xyz_m @ T_TRUE[:3, :3].T + T_TRUE[:3, 3]
        return some.maps.camera.project(q)[0]

    moved_px = pixels(widened(terms, T_TRUE, 2.0)) - pixels(terms)
    outward_px = (moved_px * OUTWARD[terms.edges.side]).sum(axis=1)
    seen = np.isfinite(outward_px)
    assert np.median(outward_px[seen]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("yaw_px", [0.0, 1.0])
def test_the_width_is_what_all_objects_are_narrower_by_whatever_the_yaw(terms, kernel, yaw_px):
    px_rad = 1 / float(terms.camera[1])
    turned = AlignmentState(STATE.changed(np.eye(8)[None, 1] * yaw_px * px_rad).T_camera_lidar[0])
    as_drawn = label_width_px(terms, turned.alone, kernel)
    narrower = label_width_px(widened(terms, T_TRUE, -1.5), turned.alone, kernel)
    assert as_drawn == pytest.approx(0.25, abs=0.5)
    assert narrower - as_drawn == pytest.approx(1.5, abs=0.5)


def curvature_of(terms, kernel):
    at_pose = np.eye(8)
    at_pose[:6, :6] = np.linalg.inv(change_jacobian(STATE.T_camera_lidar))
    return at_pose.T @ terms.gradient(STATE.alone, kernel)[1].sum(0) @ at_pose + np.diag(1 / VARIANCE)


def moved_by_borders(terms, kernel, fixed=NOT_SOLVED):
    return border_errors(terms, STATE, kernel, curvature_of(terms, kernel), VARIANCE, fixed)


def yaw_deg(rows):
    return np.degrees(np.linalg.norm(rows[:, 1]))


def far_left_aside(terms, width_px):
    edges = terms.edges
    is_left, range_m = edges.side == EDGE_LEFT, np.linalg.norm(edges.xyz_m, axis=1)
    is_far_left = is_left & (range_m > np.median(range_m[is_left]))
    aside = widened(terms, T_TRUE, width_px).edges.xyz_m
    return replace(terms, edges=replace(edges, xyz_m=np.where(is_far_left[:, None], aside, edges.xyz_m)))


def test_far_edges_beside_their_borders_make_yaw_unsure_if_they_pull(terms, kernel):
    good = yaw_deg(moved_by_borders(terms, kernel))
    assert yaw_deg(moved_by_borders(far_left_aside(terms, 2.0), kernel)) > 2 * good
    # Thirty pixels aside there is no border of theirs: they say nothing of the yaw, right or wrong.
    assert yaw_deg(moved_by_borders(far_left_aside(terms, 30.0), kernel)) < 1.5 * good


def test_rows_are_by_how_much_the_parts_pull_the_solution(terms, kernel):
    prior = Prior(T_TRUE, T_TRUE, float(np.sqrt(VARIANCE[0])), float(np.sqrt(VARIANCE[3])))

    def found(some):
        solved = refine(Scored(some, kernel, prior, SolveConfig()), STATE, steps=20, fixed=NOT_SOLVED)
        return solved.T_camera_lidar, moved_by_borders(some, kernel)[:-1, 1].sum() / np.sqrt(BORDER_SHARE)

    (T, before), (aside, after) = (found(some) for some in (terms, far_left_aside(terms, 1.0)))
    moved = change_between(T, aside)[1]
    assert abs(np.degrees(moved)) > 0.02
    assert after - before == pytest.approx(moved, rel=0.4)


def test_a_side_without_an_opposite_one_is_unsure_by_a_usual_shift_of_its_borders(terms, kernel):
    assert set(terms.edges.side) == {EDGE_LEFT, EDGE_RIGHT, EDGE_BELOW}  # nothing floats over the ground
    rows = moved_by_borders(terms, kernel)
    px_deg = np.degrees(1 / float(terms.camera[1]))
    gap_px = np.median(terms.edges.gap_rad[terms.edges.side == EDGE_BELOW]) * float(terms.camera[1])
    usual_deg = EDGE_SIDE_ALONE * np.hypot(1, gap_px) * px_deg
    # Beside markings, which know pitch as well.
    assert 0.3 * usual_deg < abs(np.degrees(rows[-1, 0])) < 1.1 * usual_deg


def test_a_camera_that_looks_aside_slides_along_its_own_x_with_the_clock():
    left = np.eye(4)
    left[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # its z is the lidar's y, its x is where the car goes
    velocity = np.array([[8.0, 0.0, 0.0], [12.0, 0.0, 0.0]])
    tz_fixed = np.arange(8) == 5
    assert np.allclose(along_the_way(left, velocity, tz_fixed), [0, 0, 0, 10, 0, 0, 0, 0])
    ahead = np.eye(4)
    ahead[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    assert np.allclose(along_the_way(ahead, velocity, tz_fixed), 0)


def test_what_is_fixed_stays_and_a_day_without_edges_says_nothing(terms, kernel):
    only_turns = np.arange(8) > 2
    assert (moved_by_borders(terms, kernel, only_turns)[:, 3:] == 0).all()
    bare = chosen(terms, np.zeros(len(terms.edges.side), bool))
    assert len(moved_by_borders(bare, kernel)) == 0

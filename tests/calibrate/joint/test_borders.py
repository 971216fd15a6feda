"""Errors that all frames share: labels too wide, borders of other things, gradients along paint, the camera's clock."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.borders import _of_image, along_paint, border_errors
from pipeline.calibrate.joint.camera_lidar.observability import along_the_way
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, Scored, refine
from pipeline.calibrate.numerics.nuisances import BORDER_SHARE, EDGE_SIDE_ALONE
from pipeline.core.config import SolveConfig
from pipeline.objective.camera_lidar.label_width import OUTWARD, label_width_px, widened
from pipeline.objective.camera_lidar.points import Points
from pipeline.objective.camera_lidar.score import KernelSettings, prepare_terms
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import change_between, change_jacobian, inverse, transform_points
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


NONE = np.zeros(8, bool)
PRIOR = np.diag(1 / np.array([0.035] * 3 + [0.05] * 3 + [0.02, 0.002]) ** 2)


def stripe(angle_deg, growth):
    """A line through the middle of an image of 80 x 120, and its brightness by row."""
    v, u = np.mgrid[:80, :120].astype(float)
    across = np.cos(np.radians(angle_deg)) * (u - 60) + np.sin(np.radians(angle_deg)) * (v - 40)
    return np.round(60 * np.exp(-0.5 * (across / 3) ** 2) * (1 + growth * (v - 40) / 40)).astype(np.int8)


AROUND = np.array([[58.0, 40.0], [60.0, 38.0], [62.5, 42.0]])


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, -50.0])
def test_an_even_line_has_no_gradient_along_itself_in_whatever_direction_it_runs(angle_deg):
    whole, along = _of_image(stripe(angle_deg, 0.0), AROUND)
    assert np.abs(whole).max() > 3
    assert np.abs(along).max() < 0.3


def line_ahead(terms, growth):
    """The terms with nothing but a line straight ahead: marked points on it, and its image in every frame."""
    camera = terms.maps.camera
    height, width = terms.maps.contrast.shape[2:]
    ray = np.column_stack([np.zeros(200), np.full(200, 1.5), np.geomspace(4.0, 60.0, 200)])  # in camera axes
    pixels, is_seen = camera.project(ray)
    inside = is_seen & np.all((pixels > 2) & (pixels < [width - 3, height - 3]), axis=1)
    pixels, ray = pixels[inside], ray[inside]
    v, u = np.mgrid[:height, :width].astype(float)
    rows = np.argsort(pixels[:, 1])
    at_u = np.interp(v[:, 0], pixels[rows, 1], pixels[rows, 0])[:, None]
    middle, half = np.mean(pixels[[0, -1], 1]), np.ptp(pixels[:, 1]) / 2
    image = np.round(
        60 * np.exp(-0.5 * ((u - at_u) / 3) ** 2) * np.clip(1 + growth * (v - middle) / half, 0, 2)
    )
    contrast = np.broadcast_to(image.astype(np.int8), terms.maps.contrast.shape).copy()
    xyz = np.tile(transform_points(inverse(T_TRUE), ray), (terms.frames, 1)).astype(np.float32)
    n, none = len(ray), np.zeros(len(xyz), np.uint8)
    zero = np.zeros(len(xyz), np.float32)
    start = np.arange(terms.frames + 1) * n
    points = Points(xyz, start, none, none, zero, zero, np.arange(terms.frames))
    only = terms.of_kinds(edges=False, markings=True)
    return replace(only, markings=points, maps=replace(terms.maps, contrast=contrast))


def drawn(terms, fixed=NONE):
    kernel = replace(KernelSettings.wide(1.5, 2), marking_weight=1.0, delta=1.0)
    edges = terms.of_kinds(edges=True, markings=False).gradient(STATE.alone, kernel)[1].sum(0)
    return along_paint(terms, STATE, kernel, edges + PRIOR, fixed)[0]


def test_a_line_ahead_that_grows_brighter_draws_pitch_and_an_even_one_does_not(terms):
    even, growing = (drawn(line_ahead(terms, growth)) for growth in (0.0, 0.4))
    assert np.abs(even[:3]).max() < np.radians(0.05)
    assert np.abs(growing[0]) > 10 * max(np.abs(even[0]), np.radians(0.02))
    assert np.abs(growing[1]) < 0.2 * np.abs(growing[0])
    fixed = drawn(line_ahead(terms, 0.4), np.arange(8) < 3)
    assert (fixed[:3] == 0).all()


def test_paint_of_a_road_with_arrows_and_lines_to_the_sides_draws_nothing(terms):
    assert np.abs(drawn(terms)[:3]).max() < np.radians(0.03)

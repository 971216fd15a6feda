"""Errors that all frames share: labels too wide, borders of other things, and a clock a camera slides along."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.observability import along_the_way
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.calibrate.joint.camera_lidar.side_bias import SidesApart, sides_apart
from pipeline.calibrate.numerics.bias_floors import EDGE_SIDE_ALONE, SIDES_APART_RANGE_M
from pipeline.objective.camera_lidar.label_width import OUTWARD, label_width_px, widened
from pipeline.objective.camera_lidar.score import KernelSettings, prepare_terms
from schemas.observations import EDGE_BELOW, EDGE_LEFT
from tests.makers.traced_scenes import DENSE, T_TRUE, traced_day

STATE = AlignmentState(T_TRUE)
NONE = np.zeros(8, bool)


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


def test_a_day_without_left_or_right_edges_tells_no_width(terms, kernel):
    assert label_width_px(chosen(terms, terms.edges.side != EDGE_LEFT), STATE.alone, kernel) == 0


def test_far_edges_that_lie_beside_their_borders_leave_the_yaw_open(terms, kernel):
    edges = terms.edges
    good = sides_apart(terms, STATE, kernel)
    assert good.pitch_px >= EDGE_SIDE_ALONE  # tops alone: nothing floats over the ground
    assert good.yaw_px < 0.5
    without = chosen(terms, edges.side != EDGE_BELOW)
    assert sides_apart(without, STATE, kernel).pitch_px == 0  # edges tell nothing of it
    is_left = edges.side == EDGE_LEFT
    range_m = np.linalg.norm(edges.xyz_m, axis=1)
    is_far_left = is_left & (range_m > np.median(range_m[is_left]))
    aside = widened(terms, T_TRUE, 3.0).edges.xyz_m
    moved = replace(edges, xyz_m=np.where(is_far_left[:, None], aside, edges.xyz_m))
    assert sides_apart(replace(terms, edges=moved), STATE, kernel).yaw_px > good.yaw_px + 1.0


def test_what_sides_leave_open_turns_about_a_point_ahead_and_nothing_that_is_fixed():
    apart = SidesApart(pitch_px=1.0, yaw_px=2.0, px_rad=0.002)
    point = np.array([0.0, 0.0, SIDES_APART_RANGE_M])
    for row in apart.biases(NONE)[:2]:
        moved = np.cross(row[:3], point) + row[3:6]
        assert np.allclose(moved, 0, atol=1e-12)
        assert np.linalg.norm(row[:3]) > 0
    only_turns = np.arange(8) > 2
    assert (apart.biases(only_turns)[:, 3:] == 0).all()
    assert apart.biases(NONE)[1, 1] == pytest.approx(2 * apart.biases(NONE)[0, 0])


def test_a_camera_that_looks_aside_slides_along_its_own_x_with_the_clock():
    left = np.eye(4)
    left[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # its z is the lidar's y, its x is where the car goes
    velocity = np.array([[8.0, 0.0, 0.0], [12.0, 0.0, 0.0]])
    tz_fixed = np.arange(8) == 5
    assert np.allclose(along_the_way(left, velocity, tz_fixed), [0, 0, 0, 10, 0, 0, 0, 0])
    ahead = np.eye(4)
    ahead[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    assert np.allclose(along_the_way(ahead, velocity, tz_fixed), 0)

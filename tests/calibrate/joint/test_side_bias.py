"""Errors that all frames share: boundaries beside their jumps, and a clock along which a camera's own x slides."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.observability import along_the_way
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.calibrate.joint.camera_lidar.side_bias import side_biases
from pipeline.objective.camera_lidar.score import KernelSettings, prepare_terms
from schemas.observations import EDGE_BELOW
from tests.makers.traced_scenes import DENSE, T_TRUE, traced_day

ONLY_TURNS = np.arange(8) > 2
STATE = AlignmentState(T_TRUE)


@pytest.fixture(scope="module")
def terms():
    day = traced_day(DENSE, 6, seed=1)
    return prepare_terms(day, T_TRUE, np.zeros((len(day), 3)), reach_rad=0.03)


def biases_of(terms):
    kernel = terms.fitted(STATE.alone, KernelSettings.wide(1.5, 2), np.random.default_rng(0))
    kernel = replace(kernel, marking_weight=0.0)
    curvature = terms.gradient(STATE.alone, kernel)[1].sum(0) + np.eye(8)
    return side_biases(terms, STATE, kernel, curvature, ONLY_TURNS)


def test_boundaries_that_all_lie_aside_turn_the_camera_by_as_much(terms):
    rows = biases_of(terms)
    assert rows.shape == (6, 8)  # left, right and tops, alike and apart: nothing floats over the ground
    assert (rows[:, ONLY_TURNS] == 0).all()
    px_rad = 1 / float(terms.camera[1])
    # All boundaries of left and right seen to the right turn it to the left, tops seen lower turn it up.
    yaw, pitch = rows[[0, 2]].sum(0)[1], rows[4][0]
    assert -1.0 * px_rad < yaw < -0.1 * px_rad
    assert 0.1 * px_rad < pitch < 2.0 * px_rad


def test_one_kind_of_edge_alone_is_its_own_bias(terms):
    tops = replace(terms, edges=terms.edges.chosen(terms.edges.side == EDGE_BELOW))
    assert len(biases_of(tops)) == 2
    none = replace(terms, edges=terms.edges.chosen(np.zeros(len(terms.edges.xyz_m), bool)))
    assert biases_of(none).shape == (0, 8)


def test_a_camera_that_looks_aside_slides_along_its_own_x_with_the_clock():
    left = np.eye(4)
    left[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # its z is the lidar's y, its x is where the car goes
    velocity = np.array([[8.0, 0.0, 0.0], [12.0, 0.0, 0.0]])
    tz_fixed = np.arange(8) == 5
    assert np.allclose(along_the_way(left, velocity, tz_fixed), [0, 0, 0, 10, 0, 0, 0, 0])
    ahead = np.eye(4)
    ahead[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    assert np.allclose(along_the_way(ahead, velocity, tz_fixed), 0)

"""Offsets to steps of brightness, and the part of the picture where paint may be."""

import numpy as np
import pytest

from pipeline.objective.camera_lidar.image_maps import NO_BOUNDARY, REACH_PX, Start, free_ground, step_offsets
from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT, STEP_BELOW, STEP_RIGHT
from tests.makers.solve_scenes import AXES

CAMERA = Camera(
    "plumb_bob", np.array([[300.0, 0, 159.5], [0, 300.0, 79.5], [0, 0, 1]]), np.zeros(0), 320, 160
)
T = from_rotation_translation(AXES, np.zeros(3))
# Free ground 5 to 40 m ahead, 3 m to each side, 1.5 m below the lidar.
GROUND = np.array([[x, y, -1.5] for x in np.arange(5.0, 41) for y in np.arange(-3.0, 4)])


def test_offsets_point_to_the_nearest_step_and_no_further_than_they_reach():
    steps = np.zeros((240, 260), np.uint8)
    steps[:, 130] = STEP_RIGHT
    steps[110] |= STEP_BELOW
    offsets = step_offsets(steps)
    to_column, to_row = 130 - np.arange(260), 110 - np.arange(240)
    for side, along, to in (
        (EDGE_LEFT, offsets[EDGE_LEFT, 5], to_column), (EDGE_RIGHT, offsets[EDGE_RIGHT, 5], to_column),
        (EDGE_ABOVE, offsets[EDGE_ABOVE, :, 5], to_row), (EDGE_BELOW, offsets[EDGE_BELOW, :, 5], to_row),
    ):  # fmt: skip
        expected = np.where(np.abs(to) <= REACH_PX, to, NO_BOUNDARY)
        np.testing.assert_array_equal(along, expected, err_msg=str(side))


@pytest.mark.parametrize("turn_deg", [-1.9, 1.9])
def test_the_ground_is_inside_where_the_start_is_off_by_no_more_than_its_sigma(turn_deg):
    off = from_rotation_translation(exp_so3(np.radians([turn_deg, 0, 0])) @ AXES, np.zeros(3))
    true, widened = (
        free_ground(GROUND, CAMERA, Start(T, 0.0)),
        free_ground(GROUND, CAMERA, Start(off, np.radians(2.0))),
    )
    assert np.mean(widened[true]) > 0.98  # the picture's lower corners move by a little more than a turn
    assert widened.sum() > true.sum()

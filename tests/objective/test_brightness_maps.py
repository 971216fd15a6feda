"""Offsets to steps of brightness, and the part of the picture where paint may be."""

import numpy as np
import pytest

from pipeline.objective.camera_lidar.image_maps import Start, free_ground, step_offsets
from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT, STEP_BELOW, STEP_RIGHT
from tests.makers.solve_scenes import AXES

NONE, REACH_PX = -128, 20
CAMERA = Camera(
    "plumb_bob", np.array([[300.0, 0, 159.5], [0, 300.0, 79.5], [0, 0, 1]]), np.zeros(0), 320, 160
)
T = from_rotation_translation(AXES, np.zeros(3))
# Free ground 5 to 40 m ahead, 3 m to each side, 1.5 m below the lidar.
GROUND = np.array([[x, y, -1.5] for x in np.arange(5.0, 41) for y in np.arange(-3.0, 4)])


def test_offsets_point_to_the_nearest_step_and_no_further_than_they_reach():
    steps = np.zeros((40, 60), np.uint8)
    steps[:, 30] = STEP_RIGHT
    steps[10] |= STEP_BELOW
    offsets = step_offsets(steps, REACH_PX, NONE)
    u, v = np.arange(60), np.arange(40)
    for side in (EDGE_LEFT, EDGE_RIGHT):
        np.testing.assert_array_equal(offsets[side, 5], np.where(np.abs(30 - u) <= REACH_PX, 30 - u, NONE))
    for side in (EDGE_ABOVE, EDGE_BELOW):
        np.testing.assert_array_equal(offsets[side, :, 5], np.where(np.abs(10 - v) <= REACH_PX, 10 - v, NONE))


@pytest.mark.parametrize("turn_deg", [-1.9, 1.9])
def test_the_ground_is_inside_where_the_start_is_off_by_no_more_than_its_sigma(turn_deg):
    off = from_rotation_translation(exp_so3(np.radians([turn_deg, 0, 0])) @ AXES, np.zeros(3))
    true, widened = (
        free_ground(GROUND, CAMERA, Start(T, 0.0)),
        free_ground(GROUND, CAMERA, Start(off, np.radians(2.0))),
    )
    assert np.mean(widened[true]) > 0.98  # the picture's lower corners move by a little more than a turn
    assert widened.sum() > true.sum()

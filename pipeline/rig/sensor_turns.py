"""A sensor turned about an axis of its own frame: azimuth, elevation or roll."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.rig.se3 import exp_so3, from_rotation_translation

__all__ = ["TURN_AXES", "sensor_turn"]

TURN_AXES = ("azimuth", "elevation", "roll")
# A camera looks along z of its frame, other sensors look along x.
_OF_CAMERA = {"azimuth": 1, "elevation": 0, "roll": 2}
_OF_OTHERS = {"azimuth": 2, "elevation": 1, "roll": 0}


def sensor_turn(axis: str, angle_rad: float, *, of_camera: bool) -> Float[np.ndarray, "4 4"]:
    """T_sensor_turned."""
    omega = np.zeros(3)
    omega[(_OF_CAMERA if of_camera else _OF_OTHERS)[axis]] = angle_rad
    return from_rotation_translation(exp_so3(omega), np.zeros(3))

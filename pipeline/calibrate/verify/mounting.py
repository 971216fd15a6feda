"""Covariance of the mounting pose, from that of the projection, and the reverse.

To first order, a principal point wrong by d pixels has the effect of a camera rotated by d / f. No alignment
separates the two, and users of the same CameraInfo still get the right pixel. This also holds through
camera-radar, where both factors use the same camera, and in lidar-radar, whose boxes come from it. So a
certified direction in the image does not certify the mounting of the camera. The mounting is known only as
well as the principal point: as stated in fleet.toml (`centre_sigma_px`), else as measured by the day, else
not at all. Likewise, a radar's own constant elevation error rotates its detections, which a record describes,
but not its mounting.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.numerics.bias_floors import RADAR_ELEVATION_BIAS_RAD
from pipeline.core.rigs import CameraPrior
from pipeline.rig.estimates import Solution
from pipeline.rig.se3 import hat

__all__ = ["camera_turn_sigma_rad", "mounting_covariance"]


def camera_turn_sigma_rad(
    solution: Solution, known: CameraPrior, K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, " 2"] | None:
    """Sigmas of the camera's pitch and yaw (about its x and y) due to the principal point.

    As measured on the day, else as stated in fleet.toml, else None.
    """
    camera_lidar = solution.pairs.get("camera_lidar")
    measured = {} if camera_lidar is None else camera_lidar.diagnostics
    names = ("mounting_pitch_sigma_rad", "mounting_yaw_sigma_rad")
    if all(name in measured for name in names):
        return np.array([measured[name] for name in names])
    return known.centre_sigma_px / np.diag(K)[[1, 0]] if known.centre_is_stated else None


def mounting_covariance(
    pair: str,
    T: Float[np.ndarray, "4 4"],
    covariance: Float[np.ndarray, "6 6"],
    turn_sigma_rad: Float[np.ndarray, " 2"] | None,
) -> Float[np.ndarray, "6 6"] | None:
    """Covariance of an estimate as a mounting pose; None if the camera's principal point is unknown.

    `covariance` is for users of the same CameraInfo and of the radar's detections; `turn_sigma_rad` is the
    camera's.
    """
    wider = np.array(covariance, np.float64)
    if pair.startswith("camera"):
        if turn_sigma_rad is None:
            return None
        wider[[0, 1], [0, 1]] += turn_sigma_rad**2
    if pair.endswith("radar"):
        # A turn about the radar's own y, as a twist about the parent's origin.
        axis = T[:3, 1]
        twist = RADAR_ELEVATION_BIAS_RAD * np.concatenate([axis, hat(T[:3, 3]) @ axis])
        wider += np.outer(twist, twist)
    return wider

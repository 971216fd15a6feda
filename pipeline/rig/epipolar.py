"""How far tracks of static points lie from epipolar lines, in pixels by the camera model's own derivative.

With a mean angle of a pixel, tracks at the sides had too little weight, and a free focal length ended 20 % short.
Source: Hartley, Zisserman 2004, section 11.4.3 (Sampson's distance).
"""

import numpy as np
from jaxtyping import Float

from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import exp_so3

__all__ = ["Seen", "off_lines_px", "seen"]

_APART_PX = 4.0
_GRID = _APART_PX * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(9, 1, 2)
_SHIFTS_PX = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
Seen = tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 2 3"]]  # bearings, their derivatives by pixels


def seen(
    camera: Camera, uv: Float[np.ndarray, "N 2"], turned_rad: Float[np.ndarray, "N 3"]
) -> tuple[Seen, ...]:
    """Pixels of a camera that turned meanwhile; then with its principal point 1 px to the right, left, down, up."""
    m = camera.unproject((uv + _GRID).reshape(-1, 2)).reshape(3, 3, -1, 3)  # by v, u
    by = np.stack([m[1, 2] - m[1, 0], m[2, 1] - m[0, 1]], 1) / (2 * _APART_PX)
    mixed = (m[2, 2] + m[0, 0] - m[2, 0] - m[0, 2]) / 4
    second = [m[1, 2] + m[1, 0] - 2 * m[1, 1], mixed, mixed, m[2, 1] + m[0, 1] - 2 * m[1, 1]]
    by_by = np.stack(second, 1).reshape(-1, 2, 2, 3) / _APART_PX**2
    ray = m[1, 1] + np.cross(turned_rad, m[1, 1])
    return tuple((ray - s @ (by - s @ by_by / 2), by - s @ by_by) for s in np.array(_SHIFTS_PX))


def off_lines_px(before: Seen, now: Seen, motion: Float[np.ndarray, " 6"]) -> Float[np.ndarray, " N"]:
    """Distances at a turn and a direction of translation, in axes midway between both orientations."""
    half, way = exp_so3(motion[:3] / 2), motion[3:] / np.linalg.norm(motion[3:])
    m0, m1 = before[0] @ half, now[0] @ half.T
    at_0, at_1 = np.cross(way, m1), np.cross(m0, way)
    slopes = [before[1] @ (at_0 @ half.T)[..., None], now[1] @ (at_1 @ half)[..., None]]
    return np.asarray((m0 * at_0).sum(1) / np.linalg.norm(np.concatenate(slopes, 1)[..., 0], axis=1))

"""Steps of brightness in an image, in the place of label borders, for a camera without semantics.

No step shows which side is nearer, so each is a border of both. Strong, long steps are taken: outlines of
poles, cars and houses, kerbs and paint, not the grain of leaves and asphalt.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from schemas.observations import STEP_BELOW, STEP_RIGHT

__all__ = ["brightness_steps"]

# Tried on the real car and on another simulator's day; a blur of 2 px, the strongest 3 % and runs of any length find
# the same pose to .05 deg.
_BLUR_PX = 1.0
_STRONGEST = 0.07  # share of the pixels
_SHORTEST_RUN_PX = 8
_GAP_PX = 4  # in a run, where another border crosses it
_LEAST_STEP = 0.5  # grey levels: in a plain image the strongest steps are rounding
_LEAST_ACROSS = 0.7  # of the step along the other axis: a step belongs to the axis that it crosses


def brightness_steps(grey: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Bits of each pixel: STEP_RIGHT if brightness steps between it and the next one of its row; STEP_BELOW."""
    right, below = _steps_along_rows(grey), _steps_along_rows(grey.T).T
    return np.asarray(STEP_RIGHT * right + STEP_BELOW * below, np.uint8)


def _steps_along_rows(grey: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Where the step to the next pixel of the row is a maximum of the row, among the strongest, and in a long run."""
    blurred = cv2.GaussianBlur(np.ascontiguousarray(grey, np.float32), (0, 0), _BLUR_PX)
    along, across = np.zeros_like(blurred), np.zeros_like(blurred)
    along[:, :-1] = np.abs(np.diff(blurred, axis=1))
    across[:-1] = np.abs(np.diff(blurred, axis=0))
    is_step = along > max(float(np.quantile(along, 1 - _STRONGEST)), _LEAST_STEP)
    is_step[:, 1:-1] &= (along[:, 1:-1] >= along[:, :-2]) & (along[:, 1:-1] > along[:, 2:])
    is_step[:, [0, -1]] = False
    is_step &= along > _LEAST_ACROSS * across
    closed = cv2.morphologyEx(is_step.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((_GAP_PX + 1, 1), np.uint8))
    _, run, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    is_long = stats[:, cv2.CC_STAT_HEIGHT] >= _SHORTEST_RUN_PX
    is_long[0] = False  # the background
    return np.asarray(is_long[run])

"""Bias of T_camera_lidar due to labels, from near and far edges of each side; more frames do not reduce it.

At the solution, near and far edges of both sides should have the same offset from their label borders. If
not, some borders belong to other objects than the lidar's edges: the roof above a car's window, the tree
behind a hedge, the wheels below a sill. This is the same in all scenes, so neither their scatter nor halves
of the day show it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.calibrate.numerics.bias_floors import (
    EDGE_SIDE_ALONE,
    EDGE_SIDE_MOST_OF_GAP,
    EDGE_SIDE_MOST_PX,
    SIDES_APART_RANGE_M,
    SIDES_APART_SHARE,
)
from pipeline.objective.camera_lidar.label_width import SHIFTS_PX, shift_score
from pipeline.objective.camera_lidar.points import Points
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT

__all__ = ["SidesApart", "most_offset_rad", "sides_apart"]

_SIDES: Final = {0: (EDGE_ABOVE, EDGE_BELOW), 1: (EDGE_LEFT, EDGE_RIGHT)}  # of pitch, of yaw
_FEWEST = 60  # edges, near or far, of a side
# So wide is what an offset is looked for in [px]: without it the offset of few edges is that of one chance border.
_OFFSET_SIGMA_PX = 4.0


@dataclass(frozen=True)
class SidesApart:
    """Differences between the offsets of near and far edges of both sides, at a solution."""

    pitch_px: float  # of the label image; edges above and below a foreground
    yaw_px: float  # edges left and right of a foreground
    px_rad: float

    def biases(self, fixed: Bool[np.ndarray, " 8"]) -> Float[np.ndarray, "3 8"]:
        """One sigma of the resulting bias of pitch and yaw, with height and x, and of roll.

        Near edges keep their position in the image, so the camera rotates as if about a point 10 m ahead.
        Coordinates are those of `AlignmentState.changed`.
        """
        rows = np.zeros((3, 8))
        rows[2, 2] = SIDES_APART_SHARE * self.pitch_px * self.px_rad
        for axis, (apart_px, shift, sign) in enumerate(((self.pitch_px, 4, 1), (self.yaw_px, 3, -1))):
            turn_rad = SIDES_APART_SHARE * apart_px * self.px_rad
            rows[axis, [axis, shift]] = turn_rad, sign * SIDES_APART_RANGE_M * turn_rad
        return np.where(fixed, 0.0, rows)


def sides_apart(terms: Terms, state: AlignmentState, kernel: KernelSettings) -> SidesApart:
    """Offsets of far edges minus near edges at a solution, in pitch and yaw; 0 where there are too few edges."""
    pitch_px, yaw_px = (_apart_px(terms, state, kernel, sides) for sides in _SIDES.values())
    return SidesApart(pitch_px, yaw_px, 1 / float(terms.camera[1]))


def most_offset_rad(edges: Points, px_rad: float) -> float:
    """Largest plausible angle between jumps in range and boundaries of one side; `px_rad`: angle of a label pixel."""
    return float(np.hypot(EDGE_SIDE_MOST_PX * px_rad, EDGE_SIDE_MOST_OF_GAP * np.median(edges.gap_rad)))


def _apart_px(terms: Terms, state: AlignmentState, kernel: KernelSettings, sides: tuple[int, int]) -> float:
    """Offset of far edges minus offset of near edges, RMS over the sides; 0 where every side has too few edges."""
    range_m, focal_px = np.linalg.norm(terms.edges.xyz_m, axis=1), float(terms.camera[1])
    far_less_near, gap_px = [], 0.0
    for side in sides:
        mine = terms.edges.side == side
        if kernel.edge_weight <= 0 or np.count_nonzero(mine) < 2 * _FEWEST:
            continue
        is_far = range_m >= np.median(range_m[mine])
        near_px, far_px = (
            _offset_px(shift_score(terms, state.alone, kernel, side, keep), kernel.edge_weight)
            for keep in (mine & ~is_far, mine & is_far)
        )
        far_less_near.append(far_px - near_px)
        gap_px = float(np.median(terms.edges.gap_rad[mine])) * focal_px
    if not far_less_near:
        return 0.0
    one_sided_px = EDGE_SIDE_ALONE * float(np.hypot(1.0, gap_px)) if len(far_less_near) == 1 else 0.0
    return float(np.hypot(np.sqrt(np.mean(np.square(far_less_near))), one_sided_px))


def _offset_px(score: Float[np.ndarray, " S"], weight: float) -> float:
    """Mean offset by a score with the same weights as in the fit."""
    log_density = min(weight, 1.0) * score - 0.5 * (SHIFTS_PX / _OFFSET_SIGMA_PX) ** 2
    density = np.exp(log_density - log_density.max())
    return float(density @ SHIFTS_PX / density.sum())

"""Excess width of a segmenter's labels over their objects, and lidar edges moved outward by it.

The border of a label is half a pixel to two pixels outside of its object. For left and right edges, which
have equal numbers, the effect cancels. For tops and feet it does not: on days whose edges are mostly tops of
cars it causes an error of pitch. Left and right edges together determine the width for any yaw, and it is
also used for tops and feet.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float

from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT

__all__ = ["OUTWARD", "SHIFTS_PX", "label_width_px", "shift_score", "widened"]

# Of the image (right, down), away from the foreground, by side.
OUTWARD: Final = np.zeros((4, 2))
OUTWARD[[EDGE_LEFT, EDGE_RIGHT, EDGE_ABOVE, EDGE_BELOW]] = [[1, 0], [-1, 0], [0, 1], [0, -1]]
SHIFTS_PX: Final = np.arange(-24, 25) / 4  # of the label image
_WIDTHS = np.arange(-4, 13)  # in steps of the shifts: -1 to 3 px
_YAWS = np.arange(-8, 9)  # likewise
# Before the day is asked [px]: labels of three segmenters on 60 days are .25 to 1.5 px too wide.
_USUAL_PX, _USUAL_SIGMA_PX = 0.6, 0.4
_FEWEST = 100  # edges of a side


def shift_score(
    terms: Terms, at: Alignments, kernel: KernelSettings, side: int, keep: np.ndarray
) -> Float[np.ndarray, " S"]:
    """Score of some edges of one side at ONE alignment, with all of them moved by SHIFTS_PX right, or down.

    Args:
        terms: points, of which only edges are used.
        at: the alignment.
        kernel: kernel of the score.
        side: side of the edges.
        keep: mask of the edges to use, all of that side.
    """
    some = replace(terms, edges=terms.edges.chosen(keep))
    axis = int(np.argmax(np.abs(OUTWARD[side])))
    score = []
    for shift_px in SHIFTS_PX:
        camera = terms.camera.copy()
        camera[3 + axis] += np.float32(shift_px)
        score.append(float(replace(some, camera=camera).edge_score(at, kernel).sum()))
    return np.array(score)


def label_width_px(terms: Terms, at: Alignments, kernel: KernelSettings) -> float:
    """Excess width of labels over their objects on each side [px of the label image].

    It is the width at which left and right edges score best together, for any yaw; 0 if a side has too few edges.
    """
    sides = [(side, terms.edges.side == side) for side in (EDGE_LEFT, EDGE_RIGHT)]
    if kernel.edge_weight <= 0 or min(np.count_nonzero(mine) for _, mine in sides) < _FEWEST:
        return 0.0
    left, right = (shift_score(terms, at, kernel, side, mine) for side, mine in sides)
    middle = len(SHIFTS_PX) // 2
    together = left[middle + _YAWS + _WIDTHS[:, None]] + right[middle + _YAWS - _WIDTHS[:, None]]
    width_px = _WIDTHS * (SHIFTS_PX[1] - SHIFTS_PX[0])
    return float(width_px[np.argmax(together.max(1) - 0.5 * ((width_px - _USUAL_PX) / _USUAL_SIGMA_PX) ** 2)])


def widened(terms: Terms, T_camera_lidar: Float[np.ndarray, "4 4"], width_px: float) -> Terms:
    """The terms with edges moved away from their foreground by the width of the labels' margin [label px]."""
    edges = terms.edges
    R = T_camera_lidar[:3, :3]
    range_m = np.linalg.norm(edges.xyz_m @ R.T + T_camera_lidar[:3, 3], axis=1)
    out = OUTWARD[edges.side] * (range_m * width_px / float(terms.camera[1]))[:, None]
    xyz_m = np.ascontiguousarray(edges.xyz_m + out @ R[:2], np.float32)
    return replace(terms, edges=replace(edges, xyz_m=xyz_m))

"""How far boundaries that lie beside what the lidar sees bias T_camera_lidar: an error that more frames do not lower.

Labels are wider than what they show, and a jump lies anywhere between two beams: at the true pose the boundaries of
one side lie a pixel or two beside its jumps. Where both sides are alike and equally far away that cancels. A camera
that looks aside sees the feet of near things and the tops of far ones: then it is a height, and a pitch.

Source: Schmidt 1966 (parameters that are considered, not solved for).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.calibrate.numerics.bias_floors import (
    EDGE_SIDE_ALIKE,
    EDGE_SIDE_APART,
    EDGE_SIDE_MOST_OF_GAP,
    EDGE_SIDE_MOST_PX,
)
from pipeline.geometry.changes import change_jacobian
from pipeline.objective.camera_lidar.points import Points
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT

__all__ = ["most_offset_rad", "side_biases"]

# Of the image, across a side's boundaries.
_AXIS = {EDGE_LEFT: 0, EDGE_RIGHT: 0, EDGE_ABOVE: 1, EDGE_BELOW: 1}


def side_biases(
    terms: Terms,
    state: AlignmentState,
    kernel: KernelSettings,
    curvature: Float[np.ndarray, "8 8"],
    fixed: Bool[np.ndarray, " 8"],
) -> Float[np.ndarray, "_ 8"]:
    """How far one sigma of each side's offset, near and far alike and apart, moves the solution (as `changed` has it).

    Args:
        terms: points, of which edges count.
        state: the solution.
        kernel: of the gradients.
        curvature: of the cost, in the coordinates of `changed`.
        fixed: unknowns that do not follow.
    """
    to_left = np.eye(8)
    to_left[:6, :6] = np.linalg.inv(change_jacobian(state.T_camera_lidar))
    only_edges, free = replace(kernel, marking_weight=0.0), ~fixed
    out = []
    for near, far, axis in _sides(terms.edges):
        by_near, by_far = (
            to_left.T @ _pull(replace(terms, edges=edges), state, only_edges, axis) for edges in (near, far)
        )
        for pull in (EDGE_SIDE_ALIKE * (by_near + by_far), EDGE_SIDE_APART * (by_near - by_far)):
            row = np.zeros(8)
            row[free] = np.linalg.solve(curvature[np.ix_(free, free)], pull[free])
            out.append(row)
    return np.array(out).reshape(-1, 8)


def _pull(terms: Terms, state: AlignmentState, kernel: KernelSettings, axis: int) -> Float[np.ndarray, " 8"]:
    """Gradient by boundaries that lie as far aside as they ever do: they pull like a principal point that does.

    Read off at half of that to both sides: of those far beside their jumps only chance is left.
    """
    focal_px = float(terms.camera[1])
    half_px = most_offset_rad(terms.edges, 1 / focal_px) * focal_px / 2
    there, back = (
        _seen_off(terms, axis, sign * half_px).gradient(state.alone, kernel)[0].sum(0) for sign in (1, -1)
    )
    return np.asarray(there - back)


def most_offset_rad(edges: Points, px_rad: float) -> float:
    """How far boundaries of one side lie beside its jumps at most; `px_rad` is the angle of a label pixel."""
    return float(np.hypot(EDGE_SIDE_MOST_PX * px_rad, EDGE_SIDE_MOST_OF_GAP * np.median(edges.gap_rad)))


def _sides(edges: Points) -> Iterator[tuple[Points, Points, int]]:
    """Edges of each side, near ones and far ones, and the image's axis across which their boundaries lie."""
    range_m = np.linalg.norm(edges.xyz_m, axis=1)
    for side, axis in _AXIS.items():
        mine = edges.side == side
        is_near = mine & (range_m < np.median(range_m[mine])) if mine.any() else mine
        if is_near.any():
            yield edges.chosen(is_near), edges.chosen(mine & ~is_near), axis


def _seen_off(terms: Terms, axis: int, off_px: float) -> Terms:
    """With the principal point moved along one axis of the image."""
    camera = terms.camera.copy()
    camera[3 + axis] += np.float32(off_px)
    return replace(terms, camera=camera)

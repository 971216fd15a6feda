"""Bias of T_camera_lidar due to borders of other objects: how far those of each part of a side pull the solution.

Some borders in labels belong to another object than the lidar's edge: the roof above a car's window, the tree
behind a hedge, the wheels below a sill. They are the same in all scenes, so neither scatter over scenes nor
halves of the day show them. They differ between sides of objects, near and far, and left and right in the
image: each such part pulls the solution by itself, and together they leave it where it is. The scatter of
these pulls is the bias's variance (a sandwich whose clusters are the parts), times `BORDER_SHARE`. A part that
pulls nothing changes nothing, however far its edges are from their borders. A side without an opposite one has
nobody to contradict it: a usual shift of its borders is added. What moves all parts alike, such as a principal
point, moves the solution with them and is not seen here.

Source: White 1982 (the sandwich); MacKinnon, Nielsen, Webb 2023, https://doi.org/10.1002/jae.2969 (few clusters).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, derivatives, scales
from pipeline.calibrate.numerics.bias_floors import BORDER_SHARE, EDGE_SIDE_ALONE
from pipeline.calibrate.numerics.response_surface import at_least
from pipeline.objective.camera_lidar.label_width import OUTWARD
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT

__all__ = ["border_errors"]

_OPPOSITE: Final = {
    EDGE_LEFT: EDGE_RIGHT,
    EDGE_RIGHT: EDGE_LEFT,
    EDGE_ABOVE: EDGE_BELOW,
    EDGE_BELOW: EDGE_ABOVE,
}
_RANGES: Final = (1 / 3, 2 / 3)  # quantiles of range that divide a side into near, middle and far
_FEWEST = 10  # edges of a part, and three times as many of a side: fewer pull nothing
# Share of the Gauss-Newton curvature that the score's own has at least (as in `refine`): it keeps it positive.
_OF_PREDICTED = 0.5
_DEFINITE = 1e-3  # of the prior, added where the data say nothing
_SMALL_PX = 0.5  # shift for finite differences, within the kernel


def border_errors(
    terms: Terms,
    state: AlignmentState,
    kernel: KernelSettings,
    curvature: Float[np.ndarray, "8 8"],
    prior_variance: Float[np.ndarray, " 8"],
    fixed: Bool[np.ndarray, " 8"],
) -> Float[np.ndarray, "K 8"]:
    """Sigmas of a solution's bias: by how much borders of each part of a side may have moved it.

    Args:
        terms: points of the solution.
        state: the solution.
        kernel: kernel and weights of its last step.
        curvature: of the cost at the solution by Gauss-Newton, with the prior.
        prior_variance: of every unknown, by the prior alone.
        fixed: unknowns that are not solved for.

    Returns:
        One row per part, and per side without an opposite one, in coordinates of `AlignmentState.changed` [rad,
        m, s]; their sum of squares is the covariance.
    """
    free, scale = np.flatnonzero(~fixed), scales(terms, kernel)
    parts = [(side, *_pull(part, state, kernel, scale)) for side, part in _parts(terms, state.T_camera_lidar)]
    if not parts:
        return np.zeros((0, 8))
    sides = {side for side, *_ in parts}
    gradient, own = (np.array(values) for values in list(zip(*parts, strict=True))[1:])
    _, of_paint = _pull(terms.of_kinds(edges=False, markings=True), state, kernel, scale)
    prior = np.diag(scale**2 / prior_variance)
    predicted = curvature * scale * scale[:, None] - (1 - _DEFINITE) * prior
    H = at_least(own.sum(0) + of_paint, _OF_PREDICTED * predicted) + prior
    alone = [side for side in sorted(sides) if _OPPOSITE[side] not in sides]
    pulls = np.vstack(
        [
            np.sqrt(BORDER_SHARE) * gradient,
            *(_shift_gradient(terms, state, kernel, scale, side) for side in alone),
        ]
    )
    rows = np.zeros_like(pulls)
    rows[:, free] = np.linalg.solve(H[np.ix_(free, free)], pulls[:, free].T).T
    return rows * scale


def _parts(terms: Terms, T_camera_lidar: Float[np.ndarray, "4 4"]) -> Iterator[tuple[int, Terms]]:
    """Edges of each side, near, middle and far, left and right of the optical axis, with their side."""
    edges = terms.edges
    range_m = np.linalg.norm(edges.xyz_m, axis=1)
    is_right = edges.xyz_m @ T_camera_lidar[0, :3] + T_camera_lidar[0, 3] > 0
    alone = terms.of_kinds(edges=True, markings=False)
    for side in sorted(_OPPOSITE):
        mine = edges.side == side
        if np.count_nonzero(mine) < 3 * _FEWEST:
            continue
        third = np.searchsorted(np.quantile(range_m[mine], _RANGES), range_m)
        for k in range(len(_RANGES) + 1):
            for right in (False, True):
                keep = mine & (third == k) & (is_right == right)
                if np.count_nonzero(keep) >= _FEWEST:
                    yield side, replace(alone, edges=edges.chosen(keep))


def _shift_gradient(
    terms: Terms, state: AlignmentState, kernel: KernelSettings, scale: Float[np.ndarray, " 8"], side: int
) -> Float[np.ndarray, " 8"]:
    """Change of the score's gradient if all borders of one side are off by what a side alone may be."""
    mine = terms.edges.side == side
    alone = replace(terms.of_kinds(edges=True, markings=False), edges=terms.edges.chosen(mine))
    gap_px = float(np.median(terms.edges.gap_rad[mine])) * float(terms.camera[1])
    ends = []
    for sign in (1, -1):
        camera = terms.camera.copy()
        camera[3:5] += (sign * _SMALL_PX * OUTWARD[side]).astype(np.float32)
        ends.append(_pull(replace(alone, camera=camera), state, kernel, scale)[0])
    return EDGE_SIDE_ALONE * np.hypot(1.0, gap_px) * (ends[0] - ends[1]) / (2 * _SMALL_PX)


def _pull(
    terms: Terms, state: AlignmentState, kernel: KernelSettings, scale: Float[np.ndarray, " 8"]
) -> tuple[Float[np.ndarray, " 8"], Float[np.ndarray, "8 8"]]:
    """Gradient and curvature of the score of some terms, in units of `scale`."""
    gradient, H = derivatives(terms, state, kernel, scale)
    return gradient.sum(0), -H.sum(0)

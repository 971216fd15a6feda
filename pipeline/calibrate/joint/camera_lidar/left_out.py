"""Bias of T_camera_lidar due to borders of other objects: how far it moves without one side, or one part of a side.

Some borders in labels belong to another object than the lidar's edge: the roof above a car's window, the tree
behind a hedge, the wheels below a sill. They are the same in all scenes, so neither scatter over scenes nor
halves of the day show them. They differ between sides of objects, near and far, and left and right in the
image. If such a part is wrong, the solution without it is another one. A part that pulls nothing changes
nothing, however far its edges are from their borders. A side without an opposite one has nobody to
contradict it: a usual shift of its borders is added. What moves all parts alike, such as a principal point,
moves the solution with them and is not seen here.

Source: jackknife over few clusters: MacKinnon, Nielsen, Webb 2023, https://doi.org/10.1002/jae.2969.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, derivatives, scales
from pipeline.calibrate.numerics.bias_floors import EDGE_SIDE_ALONE
from pipeline.calibrate.numerics.response_surface import at_least
from pipeline.objective.camera_lidar.label_width import OUTWARD
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT

__all__ = ["left_out"]

_OPPOSITE: Final = {
    EDGE_LEFT: EDGE_RIGHT,
    EDGE_RIGHT: EDGE_LEFT,
    EDGE_ABOVE: EDGE_BELOW,
    EDGE_BELOW: EDGE_ABOVE,
}
_RANGES: Final = (1 / 3, 2 / 3)  # quantiles of range that divide a side into near, middle and far
_FEWEST = 10  # edges of a part, and three times as many of a side: fewer pull nothing
# Shares that keep curvatures positive, assumed: of the Gauss-Newton curvature that the score's own has at least (as in
# `refine`), and of the data's that remains at least without a part.
_OF_PREDICTED, _REMAINS = 0.5, 0.1
_DEFINITE = 1e-3  # of the prior, added where the data say nothing
_SMALL_PX = 0.5  # shift for finite differences, within the kernel


def left_out(
    terms: Terms,
    state: AlignmentState,
    kernel: KernelSettings,
    curvature: Float[np.ndarray, "8 8"],
    prior_variance: Float[np.ndarray, " 8"],
    fixed: Bool[np.ndarray, " 8"],
) -> Float[np.ndarray, "K 8"]:
    """Changes of a solution without each side of edges, and without each part of one: sigmas of its bias.

    Args:
        terms: points of the solution.
        state: the solution.
        kernel: kernel and weights of its last step.
        curvature: of the cost at the solution by Gauss-Newton, with the prior.
        prior_variance: of every unknown, by the prior alone.
        fixed: unknowns that are not solved for.

    Returns:
        One row per side and per part, in coordinates of `AlignmentState.changed` [rad, m, s]; their sum of
        squares is the covariance.
    """
    free, scale = np.flatnonzero(~fixed), scales(terms, kernel)
    parts = [(side, *_pull(part, state, kernel, scale)) for side, part in _parts(terms, state.T_camera_lidar)]
    if not parts:
        return np.zeros((0, 8))
    sides = np.array([side for side, *_ in parts])
    gradient, own = (np.array(values) for values in list(zip(*parts, strict=True))[1:])
    _, of_paint = _pull(terms.of_kinds(edges=False, markings=True), state, kernel, scale)
    prior = np.diag(scale**2 / prior_variance)
    predicted = curvature * scale * scale[:, None] - (1 - _DEFINITE) * prior
    data = at_least(own.sum(0) + of_paint, _OF_PREDICTED * predicted)
    of_sides = [sides == side for side in np.unique(sides)]
    rows = []
    for groups in (of_sides, list(np.eye(len(parts), dtype=bool))):
        share = np.sqrt(1 - 1 / len(groups))
        for group in groups:
            remains = at_least(data - own[group].sum(0), _REMAINS * data) + prior
            step = np.zeros(8)
            step[free] = np.linalg.solve(remains[np.ix_(free, free)], gradient[group].sum(0)[free])
            rows.append(-share * step * scale)
    for side in sorted(set(sides.tolist()) - {_OPPOSITE[side] for side in sides.tolist()}):
        shifted = _shift_gradient(terms, state, kernel, scale, side)
        step = np.zeros(8)
        step[free] = np.linalg.solve((data + prior)[np.ix_(free, free)], shifted[free])
        rows.append(step * scale)
    return np.array(rows)


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

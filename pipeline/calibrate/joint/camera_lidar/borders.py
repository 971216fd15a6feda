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

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int8

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, derivatives, scales
from pipeline.calibrate.numerics.covariance import at_least
from pipeline.calibrate.numerics.nuisances import BORDER_SHARE, EDGE_SIDE_ALONE
from pipeline.objective.camera_lidar.image_maps import CONTRAST_STEP
from pipeline.objective.camera_lidar.label_width import OUTWARD
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT

__all__ = ["along_paint", "border_errors"]

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


# --------------------------------------------------------------------------------------------------
# Bias of T_camera_lidar due to paint that only runs ahead: what moves points along a line tells nothing.
#
# Across a line the image is bright on the line alone. Along it, contrast changes slowly, with range and
# with how much of the road's row the line covers; the score follows such a trend, and its scatter over
# scenes looks like information. Ends of dashes and arrows are no lines, and count in both directions.


# Standard deviation of the window in which paint has one direction or several: half of the widest blur. Not tuned.
_AROUND_PX = 3.0
_MARGIN_PX = 20  # rows that a window and its gradients reach, and more
# Of finite differences: turns [rad], shifts [m], time [s], focal length; far below a pixel, far above rounding.
_STEPS: Final = np.array([1e-4] * 3 + [1e-3] * 4 + [1e-4])


def along_paint(
    terms: Terms,
    state: AlignmentState,
    kernel: KernelSettings,
    without_paint: Float[np.ndarray, "8 8"],
    fixed: Bool[np.ndarray, " 8"],
) -> Float[np.ndarray, "1 8"]:
    """How far a solution is drawn by gradients along lines: one sigma of its bias, as `AlignmentState.changed`.

    Args:
        without_paint: curvature of the cost at the solution by its other terms and its prior.
        fixed: unknowns that are not solved for.
    """
    out = np.zeros((1, 8))
    if kernel.marking_weight <= 0 or not len(terms.markings.xyz_m):
        return out
    J = _jacobian(terms, state)
    whole, along = (
        kernel.delta * CONTRAST_STEP * np.einsum("ni,nik->nk", g, J)
        for g in _gradients(terms, kernel, _pixels(terms, state.alone))
    )
    across = whole - along
    weight, free = kernel.marking_weight, np.flatnonzero(~fixed)
    curvature = without_paint + weight * across.T @ across
    out[0, free] = np.linalg.solve(curvature[np.ix_(free, free)], weight * along.sum(0)[free])
    return out


def _pixels(terms: Terms, at: Alignments) -> Float[np.ndarray, "N 2"]:
    """Pixels of the marked points at ONE alignment; NaN where the camera cannot see."""
    markings, camera = terms.markings, terms.maps.camera
    frame = np.repeat(np.arange(terms.frames), np.diff(markings.start))
    poses = terms.poses(at)[0].astype(np.float64).reshape(-1, 3, 4)[frame]
    points = np.einsum("nij,nj->ni", poses[..., :3], markings.xyz_m) + poses[..., 3]
    pixels, is_valid = camera.project(points)
    centre = np.asarray(terms.camera[3:5], np.float64)
    return np.where(is_valid[:, None], centre + float(at.focal[0]) * (pixels - centre), np.nan)


def _jacobian(terms: Terms, state: AlignmentState) -> Float[np.ndarray, "N 2 8"]:
    """Motion of the marked points' pixels by every unknown; 0 where one is not seen."""
    out = np.zeros((len(terms.markings.xyz_m), 2, 8))
    for k, step in enumerate(np.diag(_STEPS)):
        ahead, behind = (_pixels(terms, state.changed(sign * step[None])) for sign in (1.0, -1.0))
        out[..., k] = (ahead - behind) / (2 * _STEPS[k])
    return np.nan_to_num(out)


def _gradients(
    terms: Terms, kernel: KernelSettings, pixels: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2"]]:
    """Contrast's gradient at each pixel, and the part of it that runs along the paint there."""
    whole, along = np.zeros((2, len(pixels), 2))
    contrast, markings = terms.maps.contrast[kernel.contrast_level], terms.markings
    for frame in range(terms.frames):
        mine = slice(markings.start[frame], markings.start[frame + 1])
        if mine.start < mine.stop:
            whole[mine], along[mine] = _of_image(contrast[markings.image[frame]], pixels[mine])
    return whole, along


def _of_image(
    contrast: Int8[np.ndarray, "H W"], pixels: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """`_gradients` of one image, by its structure tensor: where all gradients are parallel, there is a line."""
    height, width = contrast.shape
    inside = np.all((pixels >= 1) & (pixels < [width - 2, height - 2]), axis=1)  # NaN is outside
    if not inside.any():
        return np.zeros_like(pixels), np.zeros_like(pixels)
    rows = pixels[inside, 1].astype(int)
    first = max(rows.min() - _MARGIN_PX, 0)  # the road is in few of an image's rows
    at = np.where(inside[:, None], pixels, 0.0).astype(np.float32) - np.array([0, first], np.float32)
    values = contrast[first : rows.max() + _MARGIN_PX].astype(np.float32)
    by_u, by_v = (cv2.Sobel(values, cv2.CV_32F, *axis, ksize=3) / 8 for axis in ((1, 0), (0, 1)))

    def there(image: Float32[np.ndarray, "H W"]) -> np.ndarray:
        return cv2.remap(image, at[:, :1], at[:, 1:], cv2.INTER_LINEAR)[:, 0].astype(np.float64) * inside

    uu, uv, vv = (
        there(cv2.GaussianBlur(product, (0, 0), _AROUND_PX)) for product in (by_u**2, by_u * by_v, by_v**2)
    )
    gradient = np.stack([there(by_u), there(by_v)], axis=1)
    # Eigenvalues of [[uu, uv], [uv, vv]], and the direction of the smaller one.
    half, apart = (uu + vv) / 2, np.hypot((uu - vv) / 2, uv)
    angle = 0.5 * np.arctan2(2 * uv, uu - vv) + np.pi / 2
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    is_line = 1 - np.maximum(half - apart, 0) / np.maximum(half + apart, 1e-9)
    along = is_line * np.sum(gradient * direction, axis=1)
    return gradient, along[:, None] * direction

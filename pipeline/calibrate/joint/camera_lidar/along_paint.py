"""Bias of T_camera_lidar due to paint that only runs ahead: what moves points along a line tells nothing.

Across a line the image is bright on the line alone. Along it, contrast changes slowly, with range and with how much of
the road's row the line covers; the score follows such a trend, and its scatter over scenes looks like information. Ends
of dashes and arrows are no lines, and count in both directions.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int8

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.objective.camera_lidar.image_maps import CONTRAST_STEP
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms

__all__ = ["along_paint"]

# Standard deviation of the window in which paint has one direction or several: half of the widest blur. Not tuned.
_AROUND_PX = 3.0
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
    at = np.where(inside[:, None], pixels, 0.0).astype(np.float32)
    values = contrast.astype(np.float32)
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

"""Offset of a day's labels to its images, and its effect on camera-lidar, without extrinsics.

Fit, halves and held-out frames all match depth edges to the same label borders, so a shift of all labels
(padding, a resize) rotates the camera unseen. The image gradients (`perceive.label_gradients`) show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.numerics.frame_blocks import scene_blocks
from pipeline.extrinsics.checks import FailedCheck
from pipeline.extrinsics.estimates import PairEstimate, Solution
from schemas.observations import Observation

__all__ = ["LabelOffset", "measure_label_offset", "with_label_offset"]

_SMOOTH_PX = 1.5  # borders of sharp labels are two to four pixels wide in the picture
_FINE = 8  # steps per pixel of the smoothed gradients
_SIGMAS = 3.0
# By what share of its half width the picture's own structure moves the maximum, and by what at least [px]: the middle,
# and the ends beyond it, to the right and down. From twelve simulated days of eight rigs (two nights and a dusk among
# them), the real car, KITTI and other_world: none of their 60 offsets lay beyond two of these sigmas.
_FLOOR_OF_WIDTH = np.array([[0.04, 0.08], [0.07, 0.22]])
_FLOOR_PX = np.array([[0.03, 0.05], [0.1, 0.1]])
_SEEN_PX = 1.0  # slips are whole label pixels: where the day would show one, nothing is left open
_NOWHERE_PX = 10.0  # maxima further out are of other structures
_LARGEST_PX = np.array([13.0, 10.0, 3.0])  # shift, shift of the image's ends, width that labels have too much
_START_STEP_PX, _STEPS = 0.5, 12
_STEP_PX = 0.5  # size of the quadratic surface, and longest step
_LEAST_CURVATURE = 1e-3  # of the largest: directions that nothing determines
_DESIGN = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
_UPPER = np.triu_indices(3)
_FIT = np.linalg.pinv(
    np.column_stack([np.ones(len(_DESIGN)), _DESIGN, _DESIGN[:, _UPPER[0]] * _DESIGN[:, _UPPER[1]]])
)


@dataclass(frozen=True, eq=False)
class LabelOffset:
    """Offset of the picture's borders from the labels': label pixels to the right and down."""

    shift_px: np.ndarray  # 2
    shift_sigma_px: np.ndarray  # 2
    ends_px: np.ndarray  # 2, of the image's right and lower end beyond the shift: a slip of scale
    ends_sigma_px: np.ndarray  # 2

    @property
    def is_beside(self) -> bool:
        """Whether a shift or a slip of scale is beyond three sigmas, or too far for the picture's own borders."""
        off = np.abs([self.shift_px, self.ends_px]) / [self.shift_sigma_px, self.ends_sigma_px]
        return bool((off > _SIGMAS).any() or (np.abs(self.shift_px) > _NOWHERE_PX).any())

    @property
    def open_px(self) -> Float[np.ndarray, " 2"]:
        """Sigma of a shift that the day would not show; 0 if it would show one of a pixel."""
        return np.sqrt(np.maximum(self.shift_sigma_px**2 - (_SEEN_PX / _SIGMAS) ** 2, 0.0))

    @property
    def sentence(self) -> str:
        """The offset in words."""
        (u, v), (su, sv), (a, b), (sa, sb) = (
            self.shift_px, self.shift_sigma_px, self.ends_px, self.ends_sigma_px
        )  # fmt: skip
        return (
            f"labels are offset from their image: it is {u:+.1f} +- {su:.1f} label px right and {v:+.1f} +- {sv:.1f} "
            f"down of them in the middle, {a:+.1f} +- {sa:.1f} and {b:+.1f} +- {sb:.1f} more at the right and lower "
            "end (padding, resize or another image in the segmenter?)"
        )


def with_label_offset(solution: Solution, observations: Sequence[Observation]) -> Solution:
    """The solution with the labels' offset in camera-lidar: its numbers, a failed check, or a wider covariance.

    Unchanged where no frame has gradients.
    """
    frames = [o for o in observations if o.label_gradients is not None]
    if not frames:
        return solution
    gradients = np.stack([o.label_gradients for o in frames if o.label_gradients is not None])
    offset = measure_label_offset(gradients, scene_blocks(frames))
    focal_px = np.array([frames[0].camera_K[0, 0], frames[0].camera_K[1, 1]]) * frames[0].label_scale
    return _applied(solution, offset, focal_px)


def _applied(solution: Solution, offset: LabelOffset, focal_px: Float[np.ndarray, " 2"]) -> Solution:
    failed = dict(solution.failed_checks)
    if offset.is_beside:
        found = FailedCheck(offset.sentence, "labels_offset")
        failed["camera_lidar"] = [*failed.get("camera_lidar", []), found]
    pairs = solution.pairs | {"camera_lidar": _widened(solution.pairs["camera_lidar"], offset, focal_px)}
    return replace(solution, pairs=pairs, failed_checks=failed)


def _widened(estimate: PairEstimate, offset: LabelOffset, focal_px: Float[np.ndarray, " 2"]) -> PairEstimate:
    """Labels that are too far right rotate the camera about its y axis, labels too far down about its x axis."""
    yaw, pitch = offset.open_px / focal_px
    numbers = {
        f"label_{name}_{axis}{sigma}_px": float(value)
        for name, sigma, values in (
            ("shift", "", offset.shift_px),
            ("shift", "_sigma", offset.shift_sigma_px),
            ("ends", "", offset.ends_px),
            ("ends", "_sigma", offset.ends_sigma_px),
        )
        for axis, value in zip("uv", values, strict=True)
    }
    more = np.diag([pitch**2, yaw**2, 0, 0, 0, 0])
    return replace(
        estimate, covariance=estimate.covariance + more, diagnostics=estimate.diagnostics | numbers
    )


def measure_label_offset(gradients: Float[np.ndarray, "F 4 B D"], block: np.ndarray) -> LabelOffset:
    """The offset, from column `label_gradients` of frames and the blocks of frames that share scenes."""
    names = np.unique(block)
    of_block = np.stack([gradients[block == name].sum(0, dtype=np.float64) for name in names])
    (u, u_sigma), (v, v_sigma) = (
        _measure_axis(of_block[:, s], a) for a, s in enumerate((slice(0, 2), slice(2, 4)))
    )
    both, sigmas = np.stack([u, v], 1), np.stack([u_sigma, v_sigma], 1)
    return LabelOffset(both[0], sigmas[0], both[1], sigmas[1])


def _measure_axis(
    gradients: Float[np.ndarray, "N 2 B D"], axis: int
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Shift and shift of the ends along one axis, with sigmas: scatter over blocks, and the floor of structure."""
    smooth = gradients @ _smoothing(gradients.shape[-1])
    day = smooth.sum(0, keepdims=True)
    grids = [np.arange(-reach, reach + 0.1, _START_STEP_PX) for reach in _LARGEST_PX]
    starts = np.stack(np.meshgrid(*grids, indexing="ij"), -1).reshape(-1, 3)
    at = starts[np.argmax(_heights(day, starts)[0])]
    for _ in range(_STEPS):
        gradient, curvature = _quadratics(_heights(day, at + _STEP_PX * _DESIGN))
        step = np.clip(np.linalg.solve(_bounded(curvature[0]), gradient[0]), -1, 1)
        at = at + _STEP_PX * step
    slopes, curvature = _quadratics(_heights(smooth, at + _STEP_PX * _DESIGN))
    moves = _STEP_PX * np.linalg.solve(_bounded(curvature.sum(0)), slopes.T)
    scatter = np.sqrt((moves**2).sum(1) * len(moves.T) / max(len(moves.T) - 1, 1))
    floor = np.hypot(_FLOOR_PX[axis], _FLOOR_OF_WIDTH[axis] * _half_width_px(day, at))
    return at[:2], np.hypot(scatter[:2], floor)


def _smoothing(size: int) -> Float[np.ndarray, "D E"]:
    """Takes sums by distance to smooth ones in steps of 1/_FINE px."""
    place, fine = np.arange(size), np.arange((size - 1) * _FINE + 1) / _FINE
    weight = np.exp(-0.5 * ((place[:, None] - fine) / _SMOOTH_PX) ** 2)
    return weight / weight.sum(0)


def _heights(smooth: Float[np.ndarray, "N 2 B E"], at: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "N P"]:
    """Gradients at the picture's borders for shifts, shifts of the ends and widths that labels have too much."""
    _, _, bins, fine = smooth.shape
    place = (np.arange(bins) + 0.5) * 2 / bins - 1
    middle = at[:, :1] + at[:, 1:2] * place
    found = np.zeros((len(smooth), len(at)))
    # The foreground lies before the border, where labels too wide put the picture's border, or behind it.
    for side, sign in enumerate((-1.0, 1.0)):
        index = np.clip((middle + sign * at[:, 2:]) * _FINE + fine // 2, 0, fine - 1.001)
        low = index.astype(np.int64)
        bin_ = np.arange(bins)
        below, above = smooth[:, side, bin_, low], smooth[:, side, bin_, low + 1]
        found += (below + (above - below) * (index - low)).sum(-1)
    return found


def _quadratics(
    heights: Float[np.ndarray, "N 27"],
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3 3"]]:
    """Gradient and negative curvature of the quadratics through heights on the design."""
    c = heights @ _FIT.T
    upper = np.zeros((len(c), 3, 3))
    upper[:, _UPPER[0], _UPPER[1]] = -c[:, 4:]
    return c[:, 1:4], upper + upper.transpose(0, 2, 1)


def _bounded(curvature: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The curvature with each eigenvalue at least a small share of the largest."""
    value, vector = np.linalg.eigh(curvature)
    least = _LEAST_CURVATURE * np.abs(value).max() + np.finfo(np.float64).tiny
    return (vector * np.maximum(value, least)) @ vector.T


def _half_width_px(day: Float[np.ndarray, "1 2 B E"], at: Float[np.ndarray, " 3"]) -> float:
    """Width of the maximum at half its height over the surroundings; the whole range if there is none."""
    along = np.arange(-8, 8.01, 1 / _FINE)
    height = _heights(day, at + np.outer(along, [1, 0, 0]))[0]
    half = (height.max() + np.quantile(height, 0.15)) / 2
    return float(np.mean(height > half) * (along[-1] - along[0]) / 2)

"""Labels beside their picture: how far, and what a day does about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtr, stdtrit

from pipeline.calibrate.numerics.frame_blocks import scene_blocks
from pipeline.calibrate.reasons import because
from pipeline.rig.estimates import HARMLESS, Check, PairEstimate, Solution
from schemas.observations import Observation

__all__ = ["DayLabels", "LabelOffset", "day_labels", "measure_label_offset"]

# --------------------------------------------------------------------------------------------------
# Offset of a day's labels to its images, without extrinsics.
#
# Fit, halves and held-out frames all match depth edges to the same label borders, so a shift of all labels
# (padding, a resize) rotates the camera unseen. The image gradients (`perceive.label_gradients`) show it.
# Labels that are too wide are not displaced: what moves the left and the right borders of objects apart, or
# their tops and feet, is their width, and that of what stands before the sky is another one. With one width for
# all, labels of a coarse network, objects a pixel too wide, seemed .4 to 1.5 px beside on seven of eight days.


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
_WELL_PX = 0.4  # an offset with a larger sigma is not known well enough to be taken back
# Shift, shift of the image's ends, width that labels of objects and of what stands before the sky have too much.
_LARGEST_PX = (13.0, 10.0, 6.0, 3.0)
_START_STEP_PX, _STEPS = 0.5, 12
_STEP_PX = 0.5  # size of the quadratic surface, and longest step
_LEAST_FREEDOM = 5
_LEAST_CURVATURE = 1e-3  # of the largest: directions that nothing determines
_DESIGN = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 4, indexing="ij"), -1).reshape(-1, 4)
_UPPER = np.triu_indices(4)
_FIT = np.linalg.pinv(
    np.column_stack([np.ones(len(_DESIGN)), _DESIGN, _DESIGN[:, _UPPER[0]] * _DESIGN[:, _UPPER[1]]])
)
# Places in the column `label_gradients`, of each axis: sides of objects, and of what stands before the sky. The latter
# hardly has lower ones: along the skyline a shift looks like width, and only the picture's scale shows.
_SIDES = (([0, 1], [4, 5]), ([2, 3], [6, 7]))


@dataclass(frozen=True, eq=False)
class LabelOffset:
    """Offset of the picture's borders from the labels': label pixels to the right and down."""

    shift_px: np.ndarray  # 2
    shift_sigma_px: np.ndarray  # 2
    ends_px: np.ndarray  # 2, of the image's right and lower end beyond the shift: a slip of scale
    ends_sigma_px: np.ndarray  # 2

    @property
    def is_shifted(self) -> Bool[np.ndarray, " 2"]:
        """Whether the shift is beyond three sigmas, to the right and down."""
        return np.asarray(np.abs(self.shift_px) > _SIGMAS * self.shift_sigma_px)

    @property
    def is_beside(self) -> bool:
        """Whether a shift or a slip of scale is beyond three sigmas, or too far for the picture's own borders."""
        is_scaled = np.abs(self.ends_px) > _SIGMAS * self.ends_sigma_px
        return bool((self.is_shifted | is_scaled | (np.abs(self.shift_px) > _NOWHERE_PX)).any())

    def correction_px(self, most_px: Float[np.ndarray, " 2"]) -> Float[np.ndarray, " 2"] | None:
        """What moves the labels under the picture; None where they are beside it and cannot be moved back.

        A slip of scale cannot, nor a shift that is large or badly known.
        """
        is_small = np.abs(self.shift_px) <= most_px
        is_known = self.shift_sigma_px <= _WELL_PX
        is_scaled = np.abs(self.ends_px) > _SIGMAS * self.ends_sigma_px
        if is_scaled.any() or (self.is_shifted & ~(is_small & is_known)).any():
            return None
        return np.where(self.is_shifted, self.shift_px, 0.0)

    @property
    def open_px(self) -> Float[np.ndarray, " 2"]:
        """Sigma of a shift that the day would not show; 0 if it would show one of a pixel."""
        return np.sqrt(np.maximum(self.shift_sigma_px**2 - (_SEEN_PX / _SIGMAS) ** 2, 0.0))

    @property
    def in_words(self) -> str:
        """The offset in words."""
        values, sigmas = [*self.shift_px, *self.ends_px], [*self.shift_sigma_px, *self.ends_sigma_px]
        shown = [f"{value:+.1f} +- {sigma:.1f}" for value, sigma in zip(values, sigmas, strict=True)]
        return because(
            "labels", **dict(zip(("right", "down", "more_right", "more_down"), shown, strict=True))
        )


def measure_label_offset(gradients: Float[np.ndarray, "F 8 B D"], block: np.ndarray) -> LabelOffset:
    """The offset, from column `label_gradients` of frames and the blocks of frames that share scenes."""
    names = np.unique(block)
    of_block = np.stack([gradients[block == name].sum(0, dtype=np.float64) for name in names])
    (u, u_sigma), (v, v_sigma) = (
        _measure_axis([of_block[:, sides] for sides in kinds], axis) for axis, kinds in enumerate(_SIDES)
    )
    both, sigmas = np.stack([u, v], 1), np.stack([u_sigma, v_sigma], 1)
    return LabelOffset(both[0], sigmas[0], both[1], sigmas[1])


def _measure_axis(
    gradients: list[np.ndarray], axis: int
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Shift and shift of the ends along one axis, with sigmas: scatter over blocks, and the floor of structure."""
    smooth = [of_kind @ _smoothing(of_kind.shape[-1]) for of_kind in gradients]
    day = [of_kind.sum(0, keepdims=True) for of_kind in smooth]
    at = _highest(day)
    for _ in range(_STEPS):
        gradient, curvature = _quadratics(_heights(day, at + _STEP_PX * _DESIGN))
        step = np.clip(np.linalg.solve(_bounded(curvature[0]), gradient[0]), -1, 1)
        at = at + _STEP_PX * step
    slopes, curvature = _quadratics(_heights(smooth, at + _STEP_PX * _DESIGN))
    moves = _STEP_PX * np.linalg.solve(_bounded(curvature.sum(0)), slopes.T)
    scatter = np.sqrt((moves**2).sum(1)) * _of_few(len(moves.T))
    floor = np.hypot(_FLOOR_PX[axis], _FLOOR_OF_WIDTH[axis] * _half_width_px(day, at))
    return at[:2], np.hypot(scatter[:2], floor)


def _highest(day: list[np.ndarray]) -> Float[np.ndarray, " 4"]:
    """The best shifts on a grid, each kind of border at its own best width."""
    shift, ends, *widths = (np.arange(-most, most + 0.1, _START_STEP_PX) for most in _LARGEST_PX)
    best = []
    for of_kind, width in zip(day, widths, strict=True):
        grid = np.stack(np.meshgrid(shift, ends, width, indexing="ij"), -1)
        best.append(_heights_of(of_kind, grid.reshape(-1, 3))[0].reshape(grid.shape[:3]))
    i, j = np.unravel_index(np.argmax(best[0].max(2) + best[1].max(2)), (len(shift), len(ends)))
    return np.array([shift[i], ends[j], *(w[np.argmax(b[i, j])] for w, b in zip(widths, best, strict=True))])


def _of_few(blocks: int) -> float:
    """Factor of a scatter over so few blocks with which three sigmas are as rare as of many."""
    # Fewer than six leave a shift open that the floor of structure bounds as well.
    chance = stdtrit(max(blocks - 1, _LEAST_FREEDOM), ndtr(_SIGMAS)) / _SIGMAS
    return float(np.sqrt(blocks / max(blocks - 1, 1)) * chance)


def _smoothing(size: int) -> Float[np.ndarray, "D E"]:
    """Takes sums by distance to smooth ones in steps of 1/_FINE px."""
    place, fine = np.arange(size), np.arange((size - 1) * _FINE + 1) / _FINE
    weight = np.exp(-0.5 * ((place[:, None] - fine) / _SMOOTH_PX) ** 2)
    return weight / weight.sum(0)


def _heights(smooth: list[np.ndarray], at: Float[np.ndarray, "P 4"]) -> Float[np.ndarray, "N P"]:
    """Gradients at the picture's borders for shifts, shifts of the ends, and widths of both kinds of border."""
    return _heights_of(smooth[0], at[:, [0, 1, 2]]) + _heights_of(smooth[1], at[:, [0, 1, 3]])


def _heights_of(
    smooth: Float[np.ndarray, "N 2 B E"], at: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "N P"]:
    """`_heights` of one kind of border."""
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
    heights: Float[np.ndarray, "N 81"],
) -> tuple[Float[np.ndarray, "N 4"], Float[np.ndarray, "N 4 4"]]:
    """Gradient and negative curvature of the quadratics through heights on the design."""
    c = heights @ _FIT.T
    upper = np.zeros((len(c), 4, 4))
    upper[:, _UPPER[0], _UPPER[1]] = -c[:, 5:]
    return c[:, 1:5], upper + upper.transpose(0, 2, 1)


def _bounded(curvature: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The curvature with each eigenvalue at least a small share of the largest."""
    value, vector = np.linalg.eigh(curvature)
    least = _LEAST_CURVATURE * np.abs(value).max() + np.finfo(np.float64).tiny
    return (vector * np.maximum(value, least)) @ vector.T


def _half_width_px(day: list[np.ndarray], at: Float[np.ndarray, " 4"]) -> float:
    """Width of the maximum at half its height over the surroundings; the whole range if there is none."""
    along = np.arange(-8, 8.01, 1 / _FINE)
    height = _heights(day, at + np.outer(along, [1, 0, 0, 0]))[0]
    half = (height.max() + np.quantile(height, 0.15)) / 2
    return float(np.mean(height > half) * (along[-1] - along[0]) / 2)


# --------------------------------------------------------------------------------------------------
# Labels beside their picture: moved under it where their offset is known and small, else a failed check.
#
# An offset counts against the limit like any other error: one of less than the limit that is the same all over
# the image is taken back before the solve, and its uncertainty is part of camera-lidar's sigma. A larger one,
# one that differs over the image, or one that the day does not show well leaves the labels as they are.


@dataclass(frozen=True, eq=False)
class DayLabels:
    """Offset of a day's labels, and what of it is taken back.

    Args:
        offset: as measured.
        moved_px: by which labels are moved, to the right and down; None = they stay beside their picture.
        focal_px: focal lengths at label size.
    """

    offset: LabelOffset
    moved_px: Float[np.ndarray, " 2"] | None
    focal_px: Float[np.ndarray, " 2"]

    def in_place(self, observations: Sequence[Observation]) -> list[Observation]:
        """The observations with their labels moved under the picture."""
        if self.moved_px is None or not self.moved_px.any():
            return list(observations)
        u, v = (float(px) for px in self.moved_px)
        return [replace(o, label_offset_px=(u, v)) for o in observations]

    def judged(self, solution: Solution) -> Solution:
        """The solution with the offset in camera-lidar: its numbers, a failed check, a wider covariance."""
        failed = dict(solution.failed_checks)
        if self.offset.is_beside:
            failed["camera_lidar"] = [*failed.get("camera_lidar", []), self._check(solution)]
        pairs = solution.pairs | {"camera_lidar": self._widened(solution.pairs["camera_lidar"])}
        return replace(solution, pairs=pairs, failed_checks=failed)

    def _check(self, solution: Solution) -> Check:
        reason = self.offset.in_words
        if self.moved_px is None:
            return Check(reason, "labels_offset")
        d = solution.pairs["camera_lidar"].diagnostics
        turned = [f"{name} by {d[f'labels_moved_{name}_deg']:+.2f} deg"
                  for name in ("pitch", "yaw") if f"labels_moved_{name}_deg" in d]  # fmt: skip
        effect = f", which turned {' and '.join(turned)}" if turned else ""
        return Check(because("labels moved", reason=reason, effect=effect), "labels_offset", error=HARMLESS)

    def _widened(self, estimate: PairEstimate) -> PairEstimate:
        """Labels too far right rotate the camera about its y axis, labels too far down about its x axis."""
        offset = self.offset
        moved_px = np.zeros(2) if self.moved_px is None else self.moved_px
        yaw, pitch = np.where(moved_px == 0, offset.open_px, offset.shift_sigma_px) / self.focal_px
        numbers = {
            f"label_{name}_{axis}{sigma}_px": float(value)
            for name, sigma, values in (
                ("shift", "", offset.shift_px),
                ("shift", "_sigma", offset.shift_sigma_px),
                ("ends", "", offset.ends_px),
                ("ends", "_sigma", offset.ends_sigma_px),
                ("moved", "", moved_px),
            )
            for axis, value in zip("uv", values, strict=True)
        }
        more = np.diag([pitch**2, yaw**2, 0, 0, 0, 0])
        diagnostics = estimate.diagnostics | numbers
        return replace(estimate, covariance=estimate.covariance + more, diagnostics=diagnostics)


def day_labels(observations: Sequence[Observation], limit_rad: float) -> DayLabels | None:
    """Labels of a day; None where no frame has gradients (without semantics).

    Args:
        limit_rad: an offset of more is not taken back: nobody should drive with such labels.
    """
    frames = [o for o in observations if o.label_gradients is not None]
    if not frames:
        return None
    gradients = np.stack([o.label_gradients for o in frames if o.label_gradients is not None])
    offset = measure_label_offset(gradients, scene_blocks(frames))
    focal_px = np.array([frames[0].camera_K[0, 0], frames[0].camera_K[1, 1]]) * frames[0].label_scale
    return DayLabels(offset, offset.correction_px(limit_rad * focal_px), focal_px)

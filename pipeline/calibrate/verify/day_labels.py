"""Labels beside their picture: moved under it where their offset is known and small, else a failed check.

An offset counts against the limit like any other error: one of less than the limit that is the same all over
the image is taken back before the solve, and its uncertainty is part of camera-lidar's sigma. A larger one,
one that differs over the image, or one that the day does not show well leaves the labels as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.numerics.frame_blocks import scene_blocks
from pipeline.calibrate.verify.label_offset import LabelOffset, measure_label_offset
from pipeline.rig.checks import HARMLESS, FailedCheck
from pipeline.rig.estimates import PairEstimate, Solution
from schemas.observations import Observation

__all__ = ["DayLabels", "day_labels"]

_CAUSES = "padding, resize or another image in the segmenter?"


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

    def _check(self, solution: Solution) -> FailedCheck:
        said = f"labels are offset from their image: {self.offset.in_words} ({_CAUSES})"
        if self.moved_px is None:
            return FailedCheck(said, "labels_offset")
        d = solution.pairs["camera_lidar"].diagnostics
        turned = [f"{name} by {d[f'labels_moved_{name}_deg']:+.2f} deg"
                  for name in ("pitch", "yaw") if f"labels_moved_{name}_deg" in d]  # fmt: skip
        effect = f", which turned {' and '.join(turned)}" if turned else ""
        return FailedCheck(f"{said}; they are moved back{effect}", "labels_offset", error=HARMLESS)

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

"""Whether a day shows enough different scenes for anything to be certified: frames of a standing car are one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.calibrate.numerics.frame_blocks import FEWEST_SCENES, scenes_of
from pipeline.extrinsics.checks import FailedCheck
from schemas.observations import Observation

__all__ = ["scene_failures"]


def scene_failures(fitted: Sequence[Observation]) -> list[FailedCheck]:
    """A fit to few scenes: what they have in common passes for the calibration, and no held-out frame shows it.

    Args:
        fitted: frames that a pair was estimated from, in order of time.
    """
    scenes = len(np.unique(scenes_of(fitted)))
    if scenes >= FEWEST_SCENES or not fitted:
        return []
    shown = f"its {len(fitted)} frames show {scenes} different scene{'s' * (scenes != 1)}"
    return [FailedCheck(f"too few scenes: {shown}, needs {FEWEST_SCENES}", "few_scenes")]

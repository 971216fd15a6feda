"""Whether a day shows enough different scenes for anything to be certified: frames of a standing car are one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.calibrate.numerics.frame_blocks import FEWEST_SCENES, scenes_of
from pipeline.rig.checks import FailedCheck
from schemas.observations import Observation

__all__ = ["scene_failures"]


def scene_failures(fitted: Sequence[Observation]) -> list[FailedCheck]:
    """A failed check for a fit to few scenes: errors common to them are in held-out frames too."""
    scenes = len(np.unique(scenes_of(fitted)))
    if scenes >= FEWEST_SCENES or not fitted:
        return []
    shown = f"its {len(fitted)} frames show {scenes} different scene{'s' * (scenes != 1)}"
    return [FailedCheck(f"too few scenes: {shown}, needs {FEWEST_SCENES}", "few_scenes")]

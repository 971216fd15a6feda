"""A common error of all sources of pitch: detections measured too low, by an unknown share of their height.

A radar measures an object between its true position and its mirror image in the road. If this is ignored, all
sources rotate the estimated radar upwards at once. The registration does so by the share times the mean ratio
of height to range of the objects it uses; the Doppler velocity does so by the share times its own sensitivity.
Therefore the share is one unknown, common to both.

Nothing is measured too high, so the prior of the share is a half-normal distribution. Its sigma is the
fraction of detections below the road, without those that noise, full mirror images and strays explain
(`heights`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.part_turn import PartTurn
from pipeline.objective.radar.heights import Heights
from pipeline.objective.radar.travel import TravelDirections

__all__ = ["SeenLow", "added_share", "seen_low_of"]

# Mean and sigma of the positive half of a normal distribution, in its sigmas.
_MEAN, _SIGMA = np.sqrt(2 / np.pi), np.sqrt(1 - 2 / np.pi)
_LEAST_SHARE = 1e-3


@dataclass(frozen=True)
class SeenLow:
    """Prior mean and sigma of the share, and its effect on each source of pitch."""

    mean: float = 0.0
    sigma: float = _LEAST_SHARE
    # By how much the whole share would turn the radar up [rad].
    per_share_rad: Mapping[str, float] = field(default_factory=dict)

    def expected(self, source: PartTurn) -> PartTurn:
        """The source's pitch, corrected for the prior mean of the share."""
        per_rad = self.per_share_rad.get(source.name, 0.0)
        moved = replace(source, offset_rad=source.offset_rad + per_rad * self.mean)
        return moved.wider(per_rad * self.sigma)


def seen_low_of(travel: TravelDirections | None, heights: Heights | None) -> SeenLow:
    """The prior of the share, from the moving frames; no share without moving frames."""
    if travel is None or not travel.count:
        return SeenLow()
    below = float(np.mean(travel.below)) if heights is None else heights.seen_low(travel.below)
    by_height = max(float(np.mean(travel.height_rad)), 0.0)
    by_velocity = max(-float(np.median(travel.per_displaced)), 0.0)
    per_share = {"registration": by_height, "doppler": by_velocity}
    return SeenLow(float(_MEAN * below), max(float(_SIGMA * below), _LEAST_SHARE), per_share)


def added_share(
    axis: Float[np.ndarray, " 2"], per_share_rad: float, unknowns: int
) -> Float[np.ndarray, "P Q"]:
    """Derivative of a source's unknowns with respect to themselves and the share; the first two are rotations.

    Args:
        axis: axis of the radar's pitch.
        per_share_rad: rotation upwards that this source gives per unit of the share.
        unknowns: number of unknowns of the source.
    """
    J = np.eye(unknowns, unknowns + 1)
    J[:2, -1] = -per_share_rad * axis
    return J

"""Detections that are seen too low, by an unknown share of their height: the common error of the sources of pitch.

A radar sees things between where they are and their mirror images in the road. Who takes them for seen where they are
turns the radar up, all of them at once: the registration and boxes by the share times the height of what they see over
its range, the car's way by the share times what it does to the velocity. So the share is one unknown of all of them.

Nothing is seen too high, so its prior is half of a normal distribution. One sigma of that is the share of detections
below the road, where nothing stands, without those that noise, whole images and strays put there (`heights`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.lidar_radar.witnesses import Witness
from pipeline.objective.radar.heights import Heights
from pipeline.objective.radar.travel import TravelDirections

__all__ = ["SeenLow", "added_share", "seen_low_of"]

# Mean and sigma of the positive half of a normal distribution, in its sigmas.
_MEAN, _SIGMA = np.sqrt(2 / np.pi), np.sqrt(1 - 2 / np.pi)
_LEAST_SHARE = 1e-3


@dataclass(frozen=True)
class SeenLow:
    """Expected share and its sigma before a day's elevations are compared, and its effect on each source of pitch."""

    mean: float = 0.0
    sigma: float = _LEAST_SHARE
    # By how much the whole share would turn the radar up [rad].
    per_share_rad: Mapping[str, float] = field(default_factory=dict)

    def expected(self, witness: Witness) -> Witness:
        """The source's pitch if the share has its expected value."""
        per_rad = self.per_share_rad.get(witness.name, 0.0)
        sigma_rad = float(np.hypot(witness.sigma_rad, per_rad * self.sigma))
        return replace(witness, offset_rad=witness.offset_rad + per_rad * self.mean, sigma_rad=sigma_rad)


def seen_low_of(travel: TravelDirections | None, heights: Heights | None) -> SeenLow:
    """The share by what the moving frames show; none where there are none."""
    if travel is None or not travel.count:
        return SeenLow()
    below = float(np.mean(travel.below)) if heights is None else heights.seen_low(travel.below)
    by_height = max(float(np.mean(travel.height_rad)), 0.0)
    by_velocity = max(-float(np.median(travel.per_displaced)), 0.0)
    per_share = {"registration": by_height, "boxes": by_height, "doppler": by_velocity}
    return SeenLow(float(_MEAN * below), max(float(_SIGMA * below), _LEAST_SHARE), per_share)


def added_share(
    axis: Float[np.ndarray, " 2"], per_share_rad: float, unknowns: int
) -> Float[np.ndarray, "P Q"]:
    """Derivative of a source's unknowns, of which the first two are turns, by themselves and by the share.

    Args:
        axis: of the radar's pitch.
        per_share_rad: turn upwards of this source per share.
        unknowns: of the source.
    """
    J = np.eye(unknowns, unknowns + 1)
    J[:2, -1] = -per_share_rad * axis
    return J

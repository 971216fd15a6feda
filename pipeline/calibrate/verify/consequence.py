"""Consequence of a failed check: what it would mean at the targets, against the limits, if it is right."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.calibrate.verify.edge_result import EdgeResult
from pipeline.calibrate.verify.target_accuracy import DIRECTIONS, Claim
from pipeline.rig.changes import changed
from pipeline.rig.checks import Change
from pipeline.rig.targets import errors_at_targets

__all__ = ["RANGE", "exceeded_by", "largest_rad"]

RANGE = "range"


def exceeded_by(result: EdgeResult, claims: Mapping[str, Claim], error: Change) -> list[str]:
    """Directions whose limit the pose would exceed with such an error: azimuth, elevation, range.

    A shift along the line of sight moves no direction; it counts as if it were across it, against the limit
    of azimuth.
    """
    found = dict(zip((*DIRECTIONS, RANGE), _at_targets(result, error), strict=True))
    limits = {**claims, RANGE: claims[DIRECTIONS[0]].without_sigma}
    return [name for name, off_rad in found.items() if limits[name].is_exceeded_by(off_rad)]


def largest_rad(result: EdgeResult, error: Change) -> float:
    """Largest of the three."""
    return float(max(_at_targets(result, error)))


def _at_targets(result: EdgeResult, error: Change) -> tuple[float, float, float]:
    change = np.array(error)
    shift = np.where(
        np.arange(6) < 3, 0.0, change
    )  # a turn moves ranges by its lever arm: no more than directions
    azimuth, elevation, _ = errors_at_targets(
        result.kind, changed(result.T, change), result.T, result.targets
    )
    range_m = errors_at_targets(result.kind, changed(result.T, shift), result.T, result.targets)[2]
    per_metre = float(np.mean(1 / np.linalg.norm(result.targets, axis=1)))
    return float(azimuth), float(elevation), float(range_m) * per_metre

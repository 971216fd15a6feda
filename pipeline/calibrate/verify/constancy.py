"""Whether sensors stayed where they were over the day: its first part against its last, and which sensor moved.

All else that is asked of a day mixes its hours: even frames against odd ones, held-out blocks between the others. A
sensor that is knocked at noon is in both sides alike. So each pair is solved from the first and from the last part of
the day as well (`numerics/change_point`). Two pairs that shift and one that stays tell which sensor it was.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime

import numpy as np

from pipeline.extrinsics.attribution import PairShift, attribute
from pipeline.extrinsics.checks import FailedCheck
from pipeline.extrinsics.estimates import DayParts, PairEstimate
from pipeline.geometry.changes import change_jacobian
from pipeline.rig.edges import EDGE_OF_PAIR

__all__ = ["MOVED_SIGMAS", "PART_FLOOR_RAD", "constancy_failures"]

# Of a step between two parts of a day that are cut where they differ most.
MOVED_SIGMAS = 4.0
# By which parts differ though nothing moved: their scenes and masks do (camera-lidar's bias floor in each of them).
PART_FLOOR_RAD = float(np.radians(0.03) * np.sqrt(2))
# Of what the parts are not compared in, or do not know, when the sensor is looked for.
_ANY_RAD, _ANY_M = np.radians(20.0), 0.05
_AXES = {
    "camera_lidar": ("pitch", "yaw", "roll"),
    "camera_radar": ("pitch", "yaw", "roll"),
    "lidar_radar": ("roll", "pitch", "yaw"),
}


def constancy_failures(estimates: Mapping[str, PairEstimate]) -> dict[str, list[FailedCheck]]:
    """Pairs whose parts contradict each other, and the other pairs of the sensors that may have moved.

    Args:
        estimates: by pair; those without parts say nothing.
    """
    parts = {pair: e.parts for pair, e in estimates.items() if e.parts is not None and e.observable.any()}
    size = {pair: float(np.abs(p.sigmas(PART_FLOOR_RAD)).max()) for pair, p in parts.items()}
    moved = [pair for pair in parts if size[pair] > MOVED_SIGMAS]
    if not moved:
        return {}
    surest = max(moved, key=size.__getitem__)
    found = attribute(
        {EDGE_OF_PAIR[pair]: _shift(p, pair in moved or pair == "camera_lidar") for pair, p in parts.items()}
    )
    rivals = [s for s, share in found.probability.items() if share > 0.05] or surest.split("_")
    sensors = [found.sensor] if found.sensor else [s for s in surest.split("_") if s in rivals]
    failed = {pair: [_failure(pair, parts[pair], size[pair], sensors)] for pair in moved}
    # Which of two moved may stay open, as with a tilt that the radar hardly sees: then no pair of either is sure.
    for pair in estimates:
        if pair not in failed and set(sensors) & set(pair.split("_")):
            who, shown = " or ".join(sensors), surest.replace("_", "-")
            sentence = f"the {who} moved during the day, as {shown} shows"
            failed[pair] = [FailedCheck(sentence, "moved_in_day")]
    return failed


def _failure(pair: str, parts: DayParts, sigmas: float, sensors: list[str]) -> FailedCheck:
    axis = int(np.argmax(np.abs(parts.sigmas(PART_FLOOR_RAD))))
    first, last = (datetime.fromtimestamp(ns / 1e9, UTC).strftime("%H:%M:%S") for ns in parts.cut_ns)
    size = f"{_AXES[pair][axis]} turned by about {np.degrees(parts.step[axis]):+.2f} deg ({sigmas:.1f} sigma)"
    who = " or ".join(s for s in pair.split("_") if s in sensors) or " or ".join(pair.split("_"))
    return FailedCheck(
        f"{size} within the day, between {first} and {last} UTC: the {who} moved", "moved_in_day"
    )


def _shift(parts: DayParts, is_tilt_known: bool) -> PairShift:
    """The step as a twist; positions are open by what a turn in a bracket shifts.

    Args:
        parts: of a pair.
        is_tilt_known: a radar's witnesses of elevation show a part of a tilt only: one that they do not show may be.
    """
    change, covariance = np.zeros(6), np.eye(6) * _ANY_M**2
    change[:3] = parts.step
    covariance[:3, :3] = parts.spread[0] + parts.spread[1] + np.eye(3) * PART_FLOOR_RAD**2
    if not is_tilt_known:
        covariance[:2, :2] += np.eye(2) * _ANY_RAD**2
    to_twist = np.linalg.inv(change_jacobian(parts.T[0]))
    return PairShift(parts.T[0], to_twist @ change, to_twist @ covariance @ to_twist.T)

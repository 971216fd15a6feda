"""The status of a vehicle, decided here and nowhere else, from what its charts say."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from schemas.calibrations import PAIRS
from schemas.drift import DriftFinding, VehicleStatus

__all__ = ["decide_status"]

# Turns that every night determines; a turn of any sensor shows in one of these groups. A group is watched where all
# charts of one of its alternatives are GREEN.
# Pitch and yaw: the image's two axes.
_CAMERA_AGAINST_LIDAR = ((("camera_lidar", "rx"), ("camera_lidar", "ry")),)
# Yaw alone: radars measure azimuth ten times better than elevation, and many measure no elevation at all.
_RADAR_AGAINST_THE_OTHERS = ((("lidar_radar", "rz"),), (("camera_radar", "ry"),))
_Groups = dict[str, tuple[tuple[tuple[str, str], ...], ...]]


def _watched(pairs: Collection[str]) -> _Groups:
    """Groups of charts by the sensors whose turn shows in them, of a vehicle with these pairs."""
    watched: _Groups = {"camera or lidar": _CAMERA_AGAINST_LIDAR} if "camera_lidar" in pairs else {}
    radar = tuple(charts for charts in _RADAR_AGAINST_THE_OTHERS if charts[0][0] in pairs)
    if radar:
        watched["radar" if watched else radar[0][0][0].replace("_", " or ")] = radar
    return watched


def decide_status(findings: Sequence[DriftFinding]) -> VehicleStatus:
    """Decide the status of a vehicle, and which sensor moved, from all its charts.

    RED: at least one chart is RED, a lasting change of a size that matters.
    YELLOW: none is RED, at least one is YELLOW: a smaller change, or one that rests on a single day.
    GREEN: no chart alarms, and a turn of any sensor by the size that matters would have shown: of the pairs that the
        vehicle has, the charts of camera-lidar pitch and yaw are GREEN, and so is radar yaw against the lidar or
        against the camera. Charts that say UNKNOWN beside these do not take GREEN away: they belong to what the days
        cannot determine (radar roll, heights, on most roads), and would say UNKNOWN for ever. The reason says how many
        charts are GREEN.
    UNKNOWN: no chart alarms, but on one of those charts a change that matters could hide: too few days, sigmas too
        large, or a change that may have begun.

    The sensor, the day and the reason are those of the clearest alarm: RED before YELLOW, one whose sensor is known
    before one without, then the largest statistic in units of its threshold.

    Args:
        findings: one row per pair and DoF of one vehicle, in any order; `vehicle_*` are not read.
    """
    alarms = [f for f in findings if f.status in ("RED", "YELLOW")]
    if alarms:
        clearest = max(alarms, key=_clarity)
        reason = f"{_what_happened(clearest)}: {clearest.reason}"
        return VehicleStatus(clearest.status, reason, clearest.moved_sensor, clearest.start_day)
    status = {(f.pair, f.dof): f.status for f in findings}
    watched = _watched({f.pair for f in findings} or PAIRS)
    unwatched = [
        sensor
        for sensor, alternatives in watched.items()
        if not any(all(status.get(chart) == "GREEN" for chart in charts) for charts in alternatives)
    ]
    green = sum(s == "GREEN" for s in status.values())
    count = f"{green} of {len(findings)} charts would show a change that matters"
    if not unwatched:
        return VehicleStatus("GREEN", f"no sensor moved ({count})")
    if max((f.days_used for f in findings), default=0) > 1:
        hidden = " and of the ".join(unwatched)
        first = watched[unwatched[0]][0]  # where there is a choice
        blind = [f for f in findings if (f.pair, f.dof) in first and f.status != "GREEN"]
        why = "".join(f"; {f.pair} {f.dof}: {f.reason}" for f in blind[:1])
        return VehicleStatus("UNKNOWN", f"a turn of the {hidden} could hide ({count}){why}")
    return VehicleStatus("UNKNOWN", "too little data to say whether a sensor moved")


def _clarity(alarm: DriftFinding) -> tuple[bool, bool, float]:
    excess = (alarm.statistic or 0.0) / (alarm.threshold or 1.0)
    return alarm.status == "RED", alarm.moved_sensor is not None, excess


def _what_happened(alarm: DriftFinding) -> str:
    if alarm.moved_sensor is None:
        return f"something changed on {alarm.start_day}"
    verb = "has been drifting since" if alarm.kind == "slow drift" else "moved on"
    return f"the {alarm.moved_sensor} {verb} {alarm.start_day}"

"""The status of a vehicle from its charts; the only place that decides it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from pipeline.rig.edges import EDGE_OF_PAIR, edge_of, edge_order, words_of
from pipeline.rig.graph import KINDS, Edge
from schemas.drift import DriftFinding, VehicleStatus

__all__ = ["decide_status"]

# Turns that every night determines, by kind of edge: what a GREEN chart of them excludes. Of cameras pitch and yaw, the
# image's two axes; of radars yaw alone: they measure azimuth ten times better than elevation, and many measure none.
_WATCHED: Mapping[str, tuple[str, ...]] = {
    "camera_lidar": ("rx", "ry"),
    "camera_radar": ("ry",),
    "lidar_radar": ("rz",),
    "lidar_lidar": ("rx", "ry", "rz"),
    "lidar_base": ("rx", "ry"),
    "radar_base": ("rz",),
}
# By kind of sensor, the edges whose charts watch it; the later ones only where it has none of the earlier.
_WATCHING: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "camera": (("camera_lidar",), ("camera_radar",)),
    "lidar": (("camera_lidar", "lidar_lidar"), ("lidar_radar",), ("lidar_base",)),
    "radar": (("lidar_radar", "camera_radar"), ("radar_base",)),
}


def _watched(edges: Collection[Edge]) -> dict[str, tuple[Edge, ...]]:
    """Groups of edges: one GREEN edge of a group excludes a rotation of its named sensors, such as `front or top`."""
    ordered = sorted(edges, key=lambda e: ("base" in e.kind, e.kind == "camera_radar", edge_order(e)))
    by_edges: dict[tuple[Edge, ...], list[str]] = {}
    sensors = sorted({s for e in edges for s in e.sensors}, key=lambda s: (KINDS.index(s.kind), s.name))
    for sensor in sensors:
        own = [edge for edge in ordered if sensor in edge.sensors]
        tiers = [tuple(e for e in own if e.kind in kinds) for kinds in _WATCHING.get(sensor.kind, ())]
        watching = next((tier for tier in tiers if tier), None)
        if watching is not None:
            by_edges.setdefault(watching, []).append(sensor.name)
    return {" or ".join(names): watching for watching, names in by_edges.items()}


def decide_status(findings: Sequence[DriftFinding]) -> VehicleStatus:
    """Decide the status of a vehicle, and which sensor moved, from all its charts.

    RED: at least one chart is RED: a lasting change larger than the limit.
    YELLOW: no chart is RED, at least one is YELLOW: a smaller change, or one supported by a single day.
    GREEN: no chart alarms, and a rotation of any sensor by its limit would have been detected. For this, of
        the edges that the vehicle has, each camera's pitch and yaw against a lidar must be GREEN, and each
        radar's yaw against a lidar or a camera. Other charts may be UNKNOWN: the days cannot determine them
        on most roads (radar roll, heights), so they would stay UNKNOWN. The reason gives the number of GREEN
        charts.
    UNKNOWN: no chart alarms, but one of those charts could miss a change above the limit: it has too few
        days, its sigmas are too large, or a change may have begun.

    The sensor, the day and the reason are those of the strongest alarm. RED comes before YELLOW, an alarm
    with a known sensor before one without, then the largest ratio of statistic to threshold.

    Args:
        findings: one row per edge and DoF of one vehicle, in any order; `vehicle_*` are not read.
    """
    alarms = [f for f in findings if f.status in ("RED", "YELLOW")]
    if alarms:
        clearest = max(alarms, key=_clarity)
        reason = f"{_what_happened(clearest)}: {clearest.reason}"
        return VehicleStatus(clearest.status, reason, clearest.moved_sensor, clearest.start_day)
    status = {(edge_of(f), f.dof): f.status for f in findings}
    watched = _watched({edge for edge, _ in status} or EDGE_OF_PAIR.values())
    unwatched = [
        sensors
        for sensors, edges in watched.items()
        if not any(all(status.get((e, dof)) == "GREEN" for dof in _WATCHED[e.kind]) for e in edges)
    ]
    green = sum(s == "GREEN" for s in status.values())
    count = f"{green} of {len(findings)} charts would show a change that matters"
    if not unwatched:
        return VehicleStatus("GREEN", f"no sensor moved ({count})")
    most = max((f.days_used for f in findings), default=0)
    if most > 1:
        hidden = " and of the ".join(unwatched)
        first = watched[unwatched[0]][0]  # where there is a choice
        own = [f for f in findings if edge_of(f) == first and f.dof in _WATCHED[first.kind]]
        blind = [f for f in own if f.status != "GREEN"]
        why = "".join(f"; {words_of(first)} {f.dof}: {f.reason}" for f in blind[:1])
        return VehicleStatus("UNKNOWN", f"a turn of the {hidden} could hide ({count}){why}")
    own = [f for f in findings if f.days_used == most and (most or "needed" in f.reason)]
    why = "".join(f": {f.reason}" for f in own[:1])
    return VehicleStatus("UNKNOWN", f"too little data to say whether a sensor moved{why}")


def _clarity(alarm: DriftFinding) -> tuple[bool, bool, float]:
    excess = (alarm.statistic or 0.0) / (alarm.threshold or 1.0)
    return alarm.status == "RED", alarm.moved_sensor is not None, excess


def _what_happened(alarm: DriftFinding) -> str:
    if alarm.moved_sensor is None:
        return f"something changed on {alarm.start_day}"
    verb = "has been drifting since" if alarm.kind == "slow drift" else "moved on"
    return f"the {alarm.moved_sensor} {verb} {alarm.start_day}"

"""The status of a vehicle from its charts; the only place that decides it."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from pipeline.audit.reasons import REASONS, because
from pipeline.rig.edges import edge_of, edge_order
from pipeline.rig.graph import KINDS, Edge
from pipeline.rig.kinds import KIND_OF_EDGE
from schemas.calibrations import DOF_NAMES
from schemas.drift import DriftFinding, VehicleStatus
from schemas.words import AXIS_NAMES

__all__ = ["decide_status"]


def _watched(edges: Collection[Edge]) -> dict[str, tuple[Edge, ...]]:
    """Groups of edges: one GREEN edge of a group excludes a rotation of its named sensors, such as `front or top`."""
    ordered = sorted(edges, key=lambda e: ("base" in e.kind, e.kind == "camera_radar", edge_order(e)))
    by_edges: dict[tuple[Edge, ...], list[str]] = {}
    sensors = sorted({s for e in edges for s in e.sensors}, key=lambda s: (KINDS.index(s.kind), s.name))
    for sensor in sensors:
        own = [edge for edge in ordered if sensor in edge.sensors]
        ranks = {e: KIND_OF_EDGE[e.kind].watches.get(sensor.kind) for e in own}
        first = min((rank for rank in ranks.values() if rank is not None), default=None)
        watching = tuple(e for e in own if ranks[e] == first)
        if first is not None:
            by_edges.setdefault(watching, []).append(sensor.name)
    return {" or ".join(names): watching for watching, names in by_edges.items()}


def decide_status(findings: Sequence[DriftFinding]) -> VehicleStatus:
    """Decide the status of a vehicle, and which sensor moved, from all its charts.

    RED: at least one chart is RED: a lasting change larger than the limit.
    YELLOW: no chart is RED, at least one is YELLOW: a smaller change, or one supported by a single day.
    GREEN: no chart alarms, and a rotation of any sensor by its limit would have been detected. For this, of
        the edges that the vehicle has, each camera's pitch and yaw against a lidar must be GREEN, and each
        radar's yaw against a lidar or a camera. Other charts may be UNKNOWN: the days cannot determine them
        on most roads (radar roll, heights), so they would stay UNKNOWN. The reason gives their
        numbers.
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
        return VehicleStatus(
            clearest.status, reason, clearest.moved_sensor, clearest.start_day, clearest.days_needed
        )
    if not findings:
        return VehicleStatus("UNKNOWN", REASONS["no day"])
    blind = {}  # of each group of sensors that may have turned unseen, charts of the edge that needs the fewest days
    for sensors, edges in _watched({edge_of(f) for f in findings}).items():
        if fewest := min((_blind(findings, edge) for edge in edges), key=_days_needed):
            blind[sensors] = fewest
    few = sum(f.status != "GREEN" for f in findings)
    if not blind:
        counts = {"clear": len(findings) - few, "all": len(findings), "few": few}
        return VehicleStatus("GREEN", because("GREEN, but few" if few else "GREEN", **counts))
    # Of several, the one that has fewest days: those that begin again after a service event state it.
    charts = max(blind.values(), key=lambda own: (_days_needed(own), -min(f.days_used for f in own)))
    slowest = max(charts, key=lambda f: _days_needed([f]))
    if max(f.days_used for f in findings) > 1:
        *some, last = blind
        names = f"{', '.join(some)}{' and ' * bool(some)}{last}"
        axis = AXIS_NAMES[slowest.pair.partition("_")[0]][DOF_NAMES.index(slowest.dof)]
        chart = f"{edge_of(slowest).name} {axis}: {slowest.reason}"
        reason = because("UNKNOWN", names=names, chart=chart, few=few, all=len(findings))
    else:
        reason = because("UNKNOWN, one day", reason=slowest.reason)
    return VehicleStatus("UNKNOWN", reason, days_needed=_days_needed(charts))


def _blind(findings: Sequence[DriftFinding], edge: Edge) -> list[DriftFinding]:
    """Charts of an edge that could miss a turn of its sensors."""
    return [
        f
        for f in findings
        if edge_of(f) == edge and f.dof in KIND_OF_EDGE[edge.kind].watched and f.status != "GREEN"
    ]


def _days_needed(charts: Sequence[DriftFinding]) -> int:
    """Accepted days until none of these charts is blind."""
    return max((f.days_needed or 1 for f in charts), default=0)


def _clarity(alarm: DriftFinding) -> tuple[bool, bool, float]:
    excess = (alarm.statistic or 0.0) / (alarm.threshold or 1.0)
    return alarm.status == "RED", alarm.moved_sensor is not None, excess


def _what_happened(alarm: DriftFinding) -> str:
    if alarm.moved_sensor is None:
        return because("moved, unnamed", day=alarm.start_day)
    what = REASONS["drifts" if alarm.kind == "slow drift" else "moved"]
    return what.format(sensor=alarm.moved_sensor, day=alarm.start_day)

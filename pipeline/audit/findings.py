"""The status of a vehicle from its charts, and rows of table drift: one per edge and DoF, each with that status."""

from __future__ import annotations

import datetime as dt
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.audit.estimates import Estimates, day_name
from pipeline.audit.reasons import REASONS, because
from pipeline.audit.vehicle import VehicleVerdict, limit_of
from pipeline.audit.verdicts import ChartVerdict
from pipeline.core.config import AuditConfig
from pipeline.rig.attribution import Attribution
from pipeline.rig.graph import KINDS, Edge, edge_of, edge_order
from pipeline.rig.kinds import KIND_OF_EDGE
from schemas.calibrations import DOF_NAMES, STATUSES
from schemas.drift import DriftFinding, VehicleStatus
from schemas.words import AXIS_NAMES

__all__ = ["decide_status", "vehicle_findings"]


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


def vehicle_findings(
    about: tuple[str, str, str], records: Estimates, verdict: VehicleVerdict, config: AuditConfig,
    remarks: Mapping[tuple[Edge, str], str], before: Mapping[tuple[Edge, str], DriftFinding],
    edges: Sequence[Edge],
) -> list[DriftFinding]:  # fmt: skip
    """Rows in order of edge and DoF; a DoF without a chart has a reason. Only edges of the vehicle have rows.

    Args:
        about: vehicle, last day, method.
        before: rows of the latest earlier audit, which include days before the window.
        edges: of the rig, for a vehicle without records.
    """
    (vehicle, day, method), findings, inputs = about, [], records.keys()
    known = {*records.own_edges(), *(edge for edge, _ in before)} or {*edges}
    for edge in sorted(known, key=edge_order):
        without_data = _without_data(records, edge, max(config.baseline_days + 1, 2))
        last_estimate = _last_estimate(records, edge)
        for dof in DOF_NAMES:
            chart = verdict.charts.get((edge, dof)) or without_data
            if last_estimate:
                chart = replace(chart, reason=because("ended", reason=chart.reason, day=last_estimate))
            if (edge, dof) in remarks:
                chart = replace(chart, reason=f"{chart.reason}; {remarks[edge, dof]}")
            chart = _begun_before(chart, before.get((edge, dof)))
            base = DriftFinding(
                vehicle=vehicle, day=day, method=method, pair=edge.kind,
                parent_frame=edge.parent.name, child_frame=edge.child.name, dof=dof,
                status=chart.status, reason=chart.reason, days_used=chart.days_used, days_needed=chart.days_needed,
                limit=limit_of(edge, dof, config), statistic=chart.statistic, threshold=chart.threshold,
                inputs=inputs,
            )  # fmt: skip
            columns = _change_columns(chart, edge, verdict.attribution)
            findings.append(replace(base, **columns))
    status = decide_status(findings)
    return [
        replace(
            f, vehicle_status=status.status, vehicle_sensor=status.sensor, vehicle_since=status.since,
            vehicle_reason=status.reason, vehicle_days_needed=status.days_needed,
        )
        for f in findings
    ]  # fmt: skip


def _change_columns(chart: ChartVerdict, edge: Edge, found: Attribution | None) -> dict[str, Any]:
    """Columns of `drift` that describe a chart's change; empty without an alarm."""
    change = chart.change
    if change is None:
        return {}
    columns: dict[str, Any] = {
        "start_day": day_name(change.day),
        "start_day_earliest": day_name(change.earliest),
        "start_day_latest": day_name(change.latest),
        "kind": change.kind,
        "magnitude": change.size,
        "magnitude_sigma": change.size_sigma,
    }
    name = None if found is None else found.on(edge)
    if found is not None and len(found.moved) != 1:
        columns |= {"reason": f"{chart.reason}; {found.explanation}"}
    if found is None or name is None:
        return columns
    moved = found.moved[name]
    return columns | {
        "moved_sensor": name,
        "moved_probability": moved.probability,
        "moved_motion": moved.motion.tolist(),
        "moved_motion_sigma": np.sqrt(np.diag(moved.covariance)).tolist(),
    }


def _begun_before(chart: ChartVerdict, before: DriftFinding | None) -> ChartVerdict:
    """An earlier audit's start of the change, if it lies before the window and agrees with tonight's interval."""
    change = chart.change
    if change is None or before is None or before.start_day is None or change.kind != before.kind:
        return chart
    day, earliest, latest = (
        dt.date.fromisoformat(d).toordinal()
        for d in (before.start_day, before.start_day_earliest or "", before.start_day_latest or "")
    )
    if not (change.earliest <= day <= change.latest and day < change.day):
        return chart
    return replace(chart, change=replace(change, day=day, earliest=earliest, latest=latest))


def _last_estimate(records: Estimates, edge: Edge) -> str:
    """Day of an edge's last estimate, if the vehicle has newer records without one; else empty."""
    days = records.day[records.is_of(edge) & ~records.refused]
    return day_name(int(days.max())) if len(days) and days.max() < records.day.max() else ""


def _without_data(records: Estimates, edge: Edge, needed: int) -> ChartVerdict:
    found = records.status[records.is_of(edge)].tolist()
    kinds = [(name, found.count(STATUSES.index(name))) for name in ("held", "refused")]
    counts = ", ".join(f"{count} {name}" for name, count in kinds if count)
    reason = because("no estimate" if counts else "no record", counts=counts, needed=needed)
    return ChartVerdict("UNKNOWN", reason, 0, None, None, None, needed)

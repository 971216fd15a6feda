"""Conversion of verdicts to rows of table drift: one row per edge and DoF, each with the status of the vehicle."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.audit.estimates import Estimates, day_name
from pipeline.audit.reasons import because
from pipeline.audit.status import decide_status
from pipeline.audit.vehicle import VehicleVerdict, limit_of
from pipeline.audit.verdicts import ChartVerdict
from pipeline.core.config import AuditConfig
from pipeline.rig.attribution import Attribution
from pipeline.rig.edges import edge_order
from pipeline.rig.graph import Edge
from schemas.calibrations import DOF_NAMES, STATUSES
from schemas.drift import DriftFinding

__all__ = ["vehicle_findings"]


def vehicle_findings(
    about: tuple[str, str, str],
    records: Estimates,
    verdict: VehicleVerdict,
    config: AuditConfig,
    remarks: Mapping[tuple[Edge, str], str],
    before: Mapping[tuple[Edge, str], DriftFinding],
    edges: Sequence[Edge],
) -> list[DriftFinding]:
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
            f,
            vehicle_status=status.status,
            vehicle_sensor=status.sensor,
            vehicle_since=status.since,
            vehicle_reason=status.reason,
            vehicle_days_needed=status.days_needed,
        )
        for f in findings
    ]


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

"""From which day on a sensor's days count: since the sensor, or the reference that its pose refers to, last moved."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipeline.audit.reasons import REASONS, because
from pipeline.rig.graph import Edge, Sensor
from pipeline.store.current import current_events
from pipeline.store.partitions import Lake, days_after
from pipeline.store.records import read_records
from schemas.drift import DriftFinding
from schemas.service_events import SERVICE_EVENTS, ServiceEvent

__all__ = ["drift_per_day", "events_until", "last_restart", "restart_of"]

_ALARMS = ("RED", "YELLOW")


def last_restart(
    sensor: Sensor,
    reference: Sensor,
    events: Sequence[ServiceEvent],
    findings: Sequence[DriftFinding],
    last_day: str,
) -> tuple[str, str]:
    """First day that counts for a sensor's pose, and why; empty if all days do.

    The day of a service event belongs to neither side, because the drive may be before or after it. Where the audit
    cannot tell which end of an edge moved, either may have.
    """
    ends = {sensor.name, reference.name}
    event = _last_touching(events, ends, last_day)
    first, why = "", ""
    if event is not None:
        first, why = days_after(event.day, 1), because("after work", event=event.in_words)
    for finding in findings:
        begin = finding.start_day_latest or ""
        if finding.status not in _ALARMS or begin <= first or not ends & _moved_by(finding):
            continue
        named = finding.moved_sensor
        edge = f"{finding.parent_frame} or {finding.child_frame}"
        who = REASONS["since" if named else "since, unnamed"]
        first, why = begin, who.format(day=begin, sensor=named or edge)
    return first, why


def drift_per_day(
    sensor: Sensor, reference: Sensor, findings: Sequence[DriftFinding]
) -> Float[np.ndarray, " 6"] | None:
    """Rotation [rad] and shift [m] per day, each three times, of a slow drift found by the audit; else None."""
    rate = np.zeros(6)
    for finding in findings:
        drifts = finding.status in _ALARMS and finding.kind == "slow drift"
        if not drifts or not finding.start_day or not {sensor.name, reference.name} & _moved_by(finding):
            continue
        since = dt.date.fromisoformat(finding.start_day)
        days = max((dt.date.fromisoformat(finding.day) - since).days, 1)
        at = slice(0, 3) if finding.dof.startswith("r") else slice(3, 6)
        rate[at] = np.maximum(rate[at], abs(finding.magnitude or 0.0) / days)
    return rate if rate.any() else None


def _moved_by(finding: DriftFinding) -> set[str]:
    named = finding.moved_sensor
    return {finding.parent_frame, finding.child_frame} if named is None else {named}


def events_until(lake: Lake, last: str | None) -> dict[str, list[ServiceEvent]]:
    """Valid events by vehicle in order of day: the last version of each, without withdrawn or later ones."""
    events: dict[str, list[ServiceEvent]] = {}
    for event in current_events(read_records(lake, SERVICE_EVENTS, ServiceEvent, last=last)):
        events.setdefault(event.vehicle, []).append(event)
    return events


def restart_of(events: Sequence[ServiceEvent], edge: Edge, last_day: str) -> ServiceEvent | None:
    """The last event that moved an edge, or may have; None if there was none.

    The day of the event belongs to neither side, because the drive may be before or after it.
    """
    return _last_touching(events, {sensor.name for sensor in edge.sensors}, last_day)


def _last_touching(events: Sequence[ServiceEvent], names: set[str], last_day: str) -> ServiceEvent | None:
    touching = [e for e in events if e.day <= last_day and e.touches(names)]
    return max(touching, key=lambda e: e.day, default=None)

"""Earlier verdicts that are kept if some of their records cannot be read: missing records do not improve a status."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from pipeline.store.partitions import Lake
from pipeline.store.records import read_last
from schemas.calibrations import CALIBRATIONS
from schemas.drift import DRIFT, DriftFinding
from schemas.service_events import ServiceEvent
from schemas.states import STATES

__all__ = ["said_before", "standing"]

# From least to most urgent.
_CALMEST_FIRST = ("GREEN", "UNKNOWN", "YELLOW", "RED")
_LESS = "some of its records cannot be read"
_KEPT = f"kept, for {_LESS}"


def said_before(lake: Lake, method: str) -> Mapping[str, list[DriftFinding]]:
    """Last audit's findings of vehicles whose records may be among the unreadable ones."""
    lost = [rows for rows in lake.lost if rows.table in (CALIBRATIONS.name, STATES.name)]
    said: dict[str, list[DriftFinding]] = {}
    for finding in read_last(lake, DRIFT, DriftFinding, method) if lost else ():
        if any(rows.may_be_of(finding.vehicle) for rows in lost):
            said.setdefault(finding.vehicle, []).append(finding)
    return said


def standing(
    found: list[DriftFinding], said: Sequence[DriftFinding], events: Sequence[ServiceEvent], day: str
) -> list[DriftFinding]:
    """The valid findings of a vehicle tonight, with the reason: the last audit's if tonight's are less severe.

    `said` is empty if all of the vehicle's records could be read. Service events since the last audit end its
    findings.
    """
    if not said or any(event.recorded_at > said[0].asserted_at for event in events):
        return found
    again = [replace(row, day=day, recorded_at="", asserted_at="") for row in said]
    if not found:  # nothing of the vehicle can be read
        found = [
            replace(row, status="UNKNOWN", vehicle_status="UNKNOWN", reason=_LESS, vehicle_reason=_LESS)
            for row in again
        ]
    before, now = (_CALMEST_FIRST.index(rows[0].vehicle_status or "UNKNOWN") for rows in (said, found))
    alarmed = before >= _CALMEST_FIRST.index("YELLOW")
    if before < now or (before == now and not alarmed):
        kept = [
            row
            if _LESS in (row.vehicle_reason or "")
            else replace(row, vehicle_reason=f"{row.vehicle_reason}; {_LESS}")
            for row in found
        ]
    else:
        since = said[0].day
        kept = [
            replace(
                row, reason=_kept(row.reason, since), vehicle_reason=_kept(row.vehicle_reason or "", since)
            )
            for row in again
        ]
    # More days do not replace the records of an UNKNOWN vehicle that cannot be read.
    return [
        replace(row, vehicle_days_needed=None) if row.vehicle_status == "UNKNOWN" else row for row in kept
    ]


def _kept(reason: str, day: str) -> str:
    return reason if reason.startswith(_KEPT) else f"{_KEPT} (audit of {day}): {reason}"

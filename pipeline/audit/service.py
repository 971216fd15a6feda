"""Service events: work on a vehicle or a release, after which its references restart."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.rig.graph import Edge
from pipeline.store.current import current_events
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.service_events import SERVICE_EVENTS, ServiceEvent

__all__ = ["events_until", "restart_of"]


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
    names = [sensor.name for sensor in edge.sensors]
    touching = [e for e in events if e.day <= last_day and e.touches(names)]
    return max(touching, key=lambda e: e.day, default=None)

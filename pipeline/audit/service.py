"""Service events: what a workshop or a release did to a vehicle, after which its references begin anew."""

from __future__ import annotations

from collections.abc import Sequence

from schemas.calibrations import FRAMES_OF_PAIR
from schemas.service_events import ServiceEvent

__all__ = ["restart_of", "what_was_done"]


def restart_of(events: Sequence[ServiceEvent], pair: str, last_day: str) -> ServiceEvent | None:
    """The last event that moved a pair, or may have; None where there was none.

    The day of the event itself belongs to neither side: nobody knows whether it drove before or after.

    Args:
        events: of one vehicle.
        pair: of sensors.
        last_day: later events are not known yet.
    """
    touching = [e for e in events if e.day <= last_day and e.sensor in ("all", *FRAMES_OF_PAIR[pair])]
    return max(touching, key=lambda e: e.day, default=None)


def what_was_done(event: ServiceEvent) -> str:
    """The event in words."""
    of = "all sensors" if event.sensor == "all" else f"the {event.sensor}"
    return f"{event.kind} of {of} on {event.day}"

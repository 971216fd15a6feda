"""Table `service_events`: work on a vehicle's sensors, with day. Charts restart after it."""

from __future__ import annotations

from collections.abc import Collection

from schemas.columns import Recorded, TableSchema, column, row

__all__ = ["SERVICE_EVENTS", "ServiceEvent"]

_REALIGNED = "re-alignment"  # of a radar by its own software


@row(eq=True)
class ServiceEvent(Recorded):
    """One row of `service_events`; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD; records of this day belong to neither period")
    sensor: str = column("name of the sensor, or all")
    kind: str = column("re-mount, repair, software release, or re-alignment of a radar by its own software")
    note: str = column("for people", default="")
    withdrawn: bool = column("recorded by mistake, without effect", default=False)

    def touches(self, sensors: Collection[str]) -> bool:
        """True if the work may have moved one of the named sensors."""
        return self.sensor == "all" or self.sensor in sensors

    @property
    def in_words(self) -> str:
        """As `repair of the radar on 2026-03-07`."""
        of = "all sensors" if self.sensor == "all" else f"the {self.sensor}"
        by = " by its own software" if self.kind == _REALIGNED else ""
        return f"{self.kind} of {of}{by} on {self.day}"


SERVICE_EVENTS = TableSchema(
    ServiceEvent,
    "service_events",
    4,
    "Among events of one vehicle, day, sensor and kind, the last one recorded is valid.",
    made_by="service",
    about=("vehicle", "day", "sensor", "kind"),
)

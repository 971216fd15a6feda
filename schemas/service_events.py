"""Table `service_events`: what was done to a vehicle's sensors and when. Charts begin anew after it."""

from __future__ import annotations

from schemas.columns import Recorded, TableSchema, column, row

__all__ = ["REALIGNED", "SERVICE_EVENTS", "ServiceEvent"]

REALIGNED = "re-alignment"  # of a radar by its own software, as its messages say: noted by the audit


@row(eq=True)
class ServiceEvent(Recorded):
    """One row of `service_events`; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD; its own records count neither to before nor to after")
    sensor: str = column("name of the sensor, or all")
    kind: str = column("re-mount, repair, software release, or re-alignment of a radar by its own software")
    note: str = column("for people", default="")
    withdrawn: bool = column("it was noted by mistake: it counts no more", default=False)


SERVICE_EVENTS = TableSchema(
    ServiceEvent,
    "service_events",
    3,
    "Of events of one vehicle, day, sensor and kind, the last noted counts.",
    made_by="service",
    reads_versions=(1, 2),
    about=("vehicle", "day", "sensor", "kind"),
)

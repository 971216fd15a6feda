"""Table `service_events`: what was done to a vehicle's sensors and when. Charts begin anew after it."""

from __future__ import annotations

from dataclasses import dataclass

from schemas.columns import DEFAULT_TRIO, TableSchema, record_columns, scalar

__all__ = ["EVENT_KINDS", "EVENT_SENSORS", "SERVICE_EVENTS", "ServiceEvent"]

EVENT_KINDS = ("re-mount", "repair", "software release")
EVENT_SENSORS = ("camera", "lidar", "radar", "all")

SERVICE_EVENTS = TableSchema(
    "service_events",
    2,
    (
        scalar("vehicle", "string", "vehicle id"),
        scalar("day", "string", "YYYY-MM-DD; its own records count neither to before nor to after"),
        scalar("sensor", "string", "camera, lidar, radar or all"),
        scalar("kind", "string", "re-mount, repair or software release"),
        scalar("note", "string", "for people"),
        scalar("withdrawn", "bool", "it was noted by mistake: it counts no more"),
        *record_columns(),
    ),
    "Of events of one vehicle, day, sensor and kind, the last noted counts.",
    made_by="service",
    reads_versions=(1,),
    about=("vehicle", "day", "trio", "sensor", "kind"),
)


@dataclass(frozen=True)
class ServiceEvent:
    """One row of `service_events`; fields are the columns of the same name."""

    vehicle: str
    day: str
    sensor: str
    kind: str
    note: str = ""
    work_key: str = ""
    trio: str = DEFAULT_TRIO
    recorded_at: str = ""  # written when the row is
    asserted_at: str = ""
    withdrawn: bool = False

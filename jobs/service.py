"""`boresight service`: note what was done to a vehicle's sensors."""

from __future__ import annotations

from typing import Literal

__all__ = ["service"]


def service(
    *,
    lake: str,
    vehicle: str,
    day: str,
    kind: Literal["re-mount", "repair", "software release"],
    sensor: Literal["camera", "lidar", "radar", "all"] = "all",
    note: str = "",
) -> int:
    """Note that a sensor was mounted anew or repaired, or that a release changed its estimates: charts begin anew.

    The next audit holds the days after this one against each other, and no longer against those before. Records of the
    day itself count to neither side. Table service_events.

    Args:
        lake: folder of the tables.
        vehicle: id of the vehicle; call it once for each.
        day: on which it was done, YYYY-MM-DD.
        kind: what was done.
        sensor: which sensor; all = the whole vehicle.
        note: for people.
    """
    from jobs.terminal.summary import exit_code, print_summary
    from pipeline.store.partitions import Lake, Partition, work_key
    from pipeline.store.records import write_records
    from schemas.service_events import SERVICE_EVENTS, ServiceEvent
    from schemas.versions import CODE_VERSION

    of = Partition(vehicle, day)
    key = work_key("service", "", f"{vehicle} {day} {sensor} {kind}", [note])
    event = ServiceEvent(vehicle, day, sensor, kind, note, key)
    path = write_records(Lake.existing(lake), SERVICE_EVENTS, of, [event], key, CODE_VERSION)
    print_summary("service", "done", vehicle=vehicle, day=day, sensor=sensor, kind=kind, outputs=[path])
    return exit_code(["done"])

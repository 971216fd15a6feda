"""`boresight service`: record work on a vehicle's sensors."""

from __future__ import annotations

from typing import Literal

from jobs.terminal.summary import exit_code, print_summary
from jobs.terminal.vehicle_status import require_vehicle
from pipeline.audit.references import events_until
from pipeline.core.errors import ConfigError
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition, last_possible_day, work_key
from pipeline.store.records import read_columns
from schemas.calibrations import CALIBRATIONS
from schemas.service_events import SERVICE_EVENTS, ServiceEvent

__all__ = ["service"]


# The parameters of a command are its options: more than eight, because a user sets each of them.
def service(
    *,
    lake: str,
    vehicle: str,
    day: str,
    kind: Literal["re-mount", "repair", "software release", "re-alignment"],
    sensor: str = "all",
    note: str = "",
    withdraw: bool = False,
) -> int:
    """Record that a sensor was re-mounted or repaired, or that a software release changed its estimates.

    Charts restart: the next audit compares only the days after this one with each other. Records of the day
    itself are in neither period. Writes the table service_events.

    Args:
        lake: folder of the tables.
        vehicle: vehicle id; run the command once per vehicle.
        day: day of the work, YYYY-MM-DD.
        kind: kind of work; re-alignment: a radar's own software turned its points.
        sensor: name of the sensor, or base; all = the whole vehicle.
        note: free text.
        withdraw: withdraw an event recorded by mistake; it has no effect from the next audit on.
    """
    tables = Lake.existing(lake)
    Partition(vehicle, day)  # raises for impossible names
    if day > last_possible_day():
        raise ConfigError("command line", "day", f"{day} is in the future")
    require_vehicle(tables, vehicle)
    _require_sensor(tables, vehicle, sensor)
    noted = events_until(tables, None).get(vehicle, [])
    if withdraw and (day, sensor, kind) not in [(e.day, e.sensor, e.kind) for e in noted]:
        there = "; ".join(f"{e.kind} of {e.sensor} on {e.day}" for e in noted) or "none"
        raise ConfigError("command line", "withdraw", f"{vehicle} has no such event; it has: {there}")
    key = work_key("service", "", f"{vehicle} {day} {sensor} {kind}", [note, *(["withdrawn"] * withdraw)])
    event = ServiceEvent(
        vehicle=vehicle, day=day, sensor=sensor, kind=kind, note=note, work_key=key, withdrawn=withdraw
    )
    commit_records(tables, SERVICE_EVENTS, [event])
    about = {"vehicle": vehicle, "day": day, "sensor": sensor, "kind": kind, "withdrawn": withdraw}
    step = "run `boresight audit`, or wait for the next night: status and states change then"
    print_summary("service", "done", **about, outputs=[tables.table(SERVICE_EVENTS.name)], next_steps=[step])
    return exit_code(["done"])


def _require_sensor(lake: Lake, vehicle: str, sensor: str) -> None:
    """Raise ConfigError for a sensor without a record of this vehicle."""
    rows = read_columns(lake, CALIBRATIONS, (), first=None, last=None, vehicle=vehicle)
    known = {n for c in ("parent_frame", "child_frame") for n in (rows[c].to_pylist() if rows else ())}
    if known and sensor not in {"all", *known}:
        problem = f"{vehicle} has no {sensor!r}; its records are about {', '.join(sorted(known))}"
        raise ConfigError("command line", "sensor", problem)

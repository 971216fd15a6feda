"""`boresight service`: note what was done to a vehicle's sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from pipeline.store.partitions import Lake, Partition

__all__ = ["service"]


# A command's parameters are its options: more than eight, because each is one that a user sets.
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
    """Note that a sensor was mounted anew or repaired, or that a release changed its estimates: charts begin anew.

    The next audit holds the days after this one against each other, and no longer against those before. Records of the
    day itself count to neither side. Table service_events.

    Args:
        lake: folder of the tables.
        vehicle: id of the vehicle; call it once for each.
        day: on which it was done, YYYY-MM-DD.
        kind: what was done; re-alignment is what the audit notes of a radar that its own software turned.
        sensor: name of the sensor, or base; all = the whole vehicle.
        note: for people.
        withdraw: this was noted by mistake: from the next audit on it counts no more.
    """
    from jobs.terminal.summary import exit_code, print_summary
    from pipeline.audit.service import events_until
    from pipeline.errors import ConfigError
    from pipeline.store.commits import commit_records
    from pipeline.store.partitions import Lake, Partition, work_key
    from schemas.service_events import SERVICE_EVENTS, ServiceEvent

    tables, of = Lake.existing(lake), Partition(vehicle, day)
    _require_known(tables, of)
    _require_sensor(tables, vehicle, sensor)
    noted = events_until(tables, None).get(vehicle, [])
    if withdraw and (day, sensor, kind) not in [(e.day, e.sensor, e.kind) for e in noted]:
        there = "; ".join(f"{e.kind} of {e.sensor} on {e.day}" for e in noted) or "none"
        raise ConfigError(
            "command line", "withdraw", f"no such event of {vehicle} is noted; noted are: {there}"
        )
    key = work_key("service", "", f"{vehicle} {day} {sensor} {kind}", [note, *(["withdrawn"] * withdraw)])
    event = ServiceEvent(
        vehicle=vehicle, day=day, sensor=sensor, kind=kind, note=note, work_key=key, withdrawn=withdraw
    )
    commit_records(tables, SERVICE_EVENTS, [event])
    about = {"vehicle": vehicle, "day": day, "sensor": sensor, "kind": kind, "withdrawn": withdraw}
    print_summary("service", "done", **about, outputs=[tables.table(SERVICE_EVENTS.name)])
    return exit_code(["done"])


def _require_known(lake: Lake, of: Partition) -> None:
    """Raise ConfigError for a day that has not come yet, or a vehicle that the lake has never heard of."""
    from difflib import get_close_matches

    from pipeline.errors import ConfigError
    from pipeline.store.partitions import last_possible_day
    from pipeline.store.records import read_columns
    from schemas.calibrations import CALIBRATIONS
    from schemas.outcomes import OUTCOMES

    if of.day > last_possible_day():
        raise ConfigError("command line", "day", f"{of.day} has not come yet")
    known: set[str] = set()
    for table in (CALIBRATIONS, OUTCOMES):
        rows = read_columns(lake, table, (), first=None, last=None)
        known |= set() if rows is None else set(rows["vehicle"].unique().to_pylist())
    if of.vehicle not in known and not any(rows.may_be_of(of.vehicle) for rows in lake.lost):
        like = get_close_matches(of.vehicle, sorted(known)) or sorted(known)[:5]
        problem = f"the lake has no day of {of.vehicle!r}; it has {', '.join(like) or 'no vehicle'}"
        raise ConfigError("command line", "vehicle", problem)


def _require_sensor(lake: Lake, vehicle: str, sensor: str) -> None:
    """Raise ConfigError for a sensor that no record of the vehicle is about."""
    from pipeline.errors import ConfigError
    from pipeline.store.records import read_columns
    from schemas.calibrations import CALIBRATIONS

    rows = read_columns(lake, CALIBRATIONS, (), first=None, last=None, vehicle=vehicle)
    known = {n for c in ("parent_frame", "child_frame") for n in (rows[c].to_pylist() if rows else ())}
    if known and sensor not in {"all", *known}:
        problem = f"{vehicle} has no {sensor!r}; its records are about {', '.join(sorted(known))}"
        raise ConfigError("command line", "sensor", problem)

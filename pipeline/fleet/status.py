"""Status of every vehicle-day of a lake or of a night, as a word of `schemas.words`, with what must be corrected."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from pipeline.core.config import FleetConfig
from pipeline.fleet.nightly import DayOutcome
from schemas.outcomes import OutcomeRow
from schemas.words import day_word

__all__ = ["DayStatus", "day_statuses", "night_statuses", "night_word", "to_mend", "vehicles_to_mend"]

_LAST_STAGE = "calibrate"


@dataclass(frozen=True)
class DayStatus:
    """One vehicle-day and method.

    Args:
        method: of the calibration; empty if no calibration was reached.
        stage: last stage; empty if no stage ran.
        pairs: number of accepted, held and refused pairs.
        asserted_at: time at which a night last confirmed it.
        seconds: duration of its stages in their last runs.
        bytes_read: by these runs; None if unknown.
        bytes_written: likewise.
        faults: faults named in the reason, keys of `schemas.faults.FAULTS`.
    """

    vehicle: str
    day: str
    method: str
    status: str
    stage: str = ""
    reason: str = ""
    pairs: dict[str, int] = field(default_factory=dict)
    asserted_at: str = ""
    seconds: float = 0.0
    bytes_read: int | None = None
    bytes_written: int | None = None
    faults: list[str] = field(default_factory=list)


def day_statuses(rows: Sequence[OutcomeRow], method: str | None = None) -> list[DayStatus]:
    """Every vehicle on every day of any night, in order of day, vehicle and method (None = every method).

    A vehicle without outcome on a day on which others have one is "missing": no logs of it were found. A day
    whose night ended before its last stage is "missing" too. `rows` are in order of assertion.
    """
    stages: dict[tuple[str, str], dict[tuple[str, str], OutcomeRow]] = {}
    for row in rows:
        stages.setdefault((row.day, row.vehicle), {})[row.stage, row.method] = row
    days, vehicles = {d for d, _ in stages}, {v for _, v in stages}
    found = []
    for day in sorted(days):
        for vehicle in sorted(vehicles):
            current = stages.get((day, vehicle))
            if current is None:
                reason = "no logs of this vehicle were found, although other vehicles have some"
                found.append(DayStatus(vehicle, day, "", "missing", reason=reason))
                continue
            known = sorted({of for stage, of in current if stage == _LAST_STAGE}) or [""]
            methods = known if method is None else [method]
            found += [_of_method(vehicle, day, of, list(current.values())) for of in methods]
    return found


def night_word(statuses: Iterable[str]) -> str:
    """Word for a night that is done but for what was held or refused, from the words of its vehicle-days.

    "incomplete" if nothing was: then rows of the lake are unreadable.
    """
    words = set(statuses)
    if not words & {"partly", "held", "refused"}:
        return "incomplete"
    return words.pop() if len(words) == 1 else "partly"


def _of_method(vehicle: str, day: str, method: str, rows: Sequence[OutcomeRow]) -> DayStatus:
    own = [r for r in rows if r.method in ("", method)]
    failed = next((r for r in own if r.status == "failed"), None)
    last = next((r for r in own if r.stage == _LAST_STAGE), None)
    # Use the reason of the stage that refused, not its copy in calibrate's records of every pair.
    refused = next((r for r in own if r.status == "refused" and r.stage != _LAST_STAGE), None)
    said = failed or (refused if last is None or last.status == "refused" else None) or last
    if said is None:
        latest = max(own, key=lambda r: r.asserted_at)
        status, reason, stage = (
            "missing",
            f"the night ended after {latest.stage}, before {_LAST_STAGE}",
            latest.stage,
        )
    else:
        status, reason, stage = _status(said), said.reason, said.stage
    return DayStatus(
        vehicle, day, method, status, stage, reason,
        {} if last is None else {k: n for k, n in last.kept.items() if n}, max(r.asserted_at for r in own),
        sum(r.seconds for r in own), _total([r.bytes_read for r in own]),
        _total([r.bytes_written for r in own]), [] if said is None else list(said.faults),
    )  # fmt: skip


def _status(row: OutcomeRow) -> str:
    pairs = [status for status, count in row.kept.items() if count]
    return day_word(pairs) if row.status == "done" and pairs else row.status


def _total(values: Sequence[int | None]) -> int | None:
    known = [v for v in values if v is not None]
    return sum(known) if known else None


def to_mend(outcomes: Sequence[DayOutcome], fleet: FleetConfig) -> dict[str, str]:
    """What must be corrected: by rig if all of its days in this night are misconfigured, and by unknown vehicle.

    A rig's correction is that of its first day.
    """
    of_rig: dict[str, list[DayOutcome]] = {}
    for outcome in outcomes:
        of_rig.setdefault(_section(outcome, fleet), []).append(outcome)
    return {rig: own[0].mend for rig, own in of_rig.items() if all(o.mend for o in own)}


def vehicles_to_mend(outcomes: Sequence[DayOutcome], fleet: FleetConfig) -> dict[str, str]:
    """What must be corrected by vehicle: more days do not help before."""
    mend = to_mend(outcomes, fleet)
    return {o.vehicle: mend[section] for o in outcomes if (section := _section(o, fleet)) in mend}


def night_statuses(outcomes: Sequence[DayOutcome], fleet: FleetConfig) -> list[str]:
    """Status of each vehicle-day; "misconfigured" if a retry does not help.

    A day that failed because of its configuration is misconfigured. Another day counts only if all days of
    the rig have something to correct: a single log without a topic is no error of fleet.toml.
    """
    mend = to_mend(outcomes, fleet)
    return [
        "misconfigured" if o.mend and (o.status == "failed" or _section(o, fleet) in mend) else o.status
        for o in outcomes
    ]


def _section(outcome: DayOutcome, fleet: FleetConfig) -> str:
    """Name of the vehicle's rig, or the section of fleet.toml that an unknown vehicle lacks."""
    known = fleet.knows(outcome.vehicle)
    return fleet.vehicle(outcome.vehicle).rig if known else f'vehicles."{outcome.vehicle}"'

"""`boresight status`: which vehicle-days of a lake are done and which are not, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from jobs.terminal.summary import exit_code, left_out, print_summary
from jobs.terminal.vehicle_status import next_steps, require_vehicle, status_lines, told_of
from pipeline.audit.references import events_until
from pipeline.fleet.status import DayStatus, day_statuses
from pipeline.store.corrections import read_corrections
from pipeline.store.partitions import Lake, check_day, days_after
from pipeline.store.records import last_assertion, last_day, read_last, read_records
from schemas.drift import DRIFT, DriftFinding
from schemas.faults import in_words
from schemas.outcomes import OUTCOMES, OutcomeRow
from schemas.words import DAY_WORDS

__all__ = ["status"]

_ROWS = 40  # rows of the printed table; the others are counted


# The parameters of a command are its options: more than eight, because a user sets each of them.
def status(
    *,
    lake: str,
    vehicle: str | None = None,
    method: str | None = None,
    from_day: Annotated[str | None, Parameter(name="--from")] = None,
    to_day: Annotated[str | None, Parameter(name="--to")] = None,
    json: bool = False,
) -> int:
    """Show the status of every vehicle and vehicle-day, with reasons; the most urgent come first.

    Args:
        lake: folder of the tables.
        vehicle: only this vehicle.
        method: calibration method; default: the method of the last audit. Each vehicle-day counts once.
        from_day: first day, YYYY-MM-DD; default: 31 days before the last.
        to_day: last day; default: the last day in any night.
        json: list every vehicle-day in the summary's "days".
    """
    check_day("to", to_day)
    tables = Lake.existing(lake)
    last = to_day or last_day(tables, OUTCOMES)
    first = from_day or (None if last is None else days_after(last, -30))
    rows = read_records(tables, OUTCOMES, OutcomeRow, first=first, last=last)
    method = method or _audited_method(tables, {r.method for r in rows if r.method})
    found = [s for s in day_statuses(rows, method) if vehicle in (None, s.vehicle)]
    findings = read_last(tables, DRIFT, DriftFinding, method, vehicle=vehicle)
    if vehicle is not None and not (found or findings):
        require_vehicle(tables, vehicle)
    mend = {v: what for v, what in read_corrections(tables, to_day).items() if vehicle in (None, v)}
    steps = next_steps(findings, lake, mend, _unaudited(findings, tables))
    if not json:
        _print_table(found, [*status_lines(findings), *map(escape, steps)])
    damaged = left_out(tables)
    ended = "incomplete" if damaged else "done"
    print_summary(
        "status",
        ended,
        lake=lake,
        first=first,
        last=last,
        method=method,
        vehicles=len({s.vehicle for s in found}),
        **{name: sum(s.status == name for s in found) for name in DAY_WORDS},
        **told_of(findings),
        next_steps=steps,
        misconfigured=mend,
        damaged=damaged,
        **({"days": [asdict(s) for s in found]} if json else {}),
    )
    return exit_code([ended])


def _unaudited(findings: Sequence[DriftFinding], lake: Lake) -> dict[str, str]:
    """A step for each vehicle with a service event that was recorded after its audit."""
    audited = {finding.vehicle: finding.asserted_at for finding in findings}
    return {
        vehicle: f"{vehicle}: {last.kind} of {last.sensor} on {last.day} is not audited yet: run `boresight audit`"
        for vehicle, events in events_until(lake, None).items()
        if (last := max(events, key=lambda e: e.asserted_at)).asserted_at > audited.get(vehicle, "9")
    }


def _audited_method(lake: Lake, others: set[str]) -> str:
    """The method of the last audit; without an audit the default method, or a method that has records."""
    last = last_assertion(lake, DRIFT)
    if last is not None:
        return last.method
    return "joint" if "joint" in others or not others else min(others)


def _print_table(days: Sequence[DayStatus], vehicles: Sequence[str]) -> None:
    wanting = sorted((d for d in days if d.status != "done"), key=lambda d: [*DAY_WORDS].index(d.status))
    table = Table("vehicle", "day", "status", "stage", "why")
    for day in wanting[:_ROWS]:
        # Text, because names and reasons may contain rich markup.
        why = "; ".join(text for text in (in_words(day.faults), day.reason) if text)
        table.add_row(*(Text(t) for t in (day.vehicle, day.day, day.status, day.stage, why)))
    console = Console()
    if wanting:
        console.print(table)
    if len(wanting) > _ROWS:
        console.print(f"and {len(wanting) - _ROWS} more: --json lists them all")
    console.print(f"{len(days) - len(wanting)} of {len(days)} vehicle-days are done")
    for line in vehicles[:_ROWS]:
        console.print(line, highlight=False)

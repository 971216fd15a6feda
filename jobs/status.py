"""`boresight status`: what of a lake is done, held, refused, failed or missing, and why."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

if TYPE_CHECKING:
    from pipeline.fleet.status import DayStatus

__all__ = ["status"]

_ROWS = 40  # of a table for people: the others are counted


# A command's parameters are its options: more than eight, because each is one that a user sets.
def status(
    *,
    lake: str,
    vehicle: str | None = None,
    method: str | None = None,
    from_day: Annotated[str | None, Parameter(name="--from")] = None,
    to_day: Annotated[str | None, Parameter(name="--to")] = None,
    json: bool = False,
) -> int:
    """Tell how every vehicle-day stands, and why: what a person should look at first comes first.

    Args:
        lake: folder of the tables.
        vehicle: only this vehicle.
        method: only calibrations of this method.
        from_day: first day, YYYY-MM-DD; default: 31 days before the last.
        to_day: last day; default: the last day that any night was about.
        json: the summary's "days" lists every vehicle-day.
    """
    from dataclasses import asdict

    from jobs.terminal.summary import left_out, print_summary
    from pipeline.fleet.status import DAY_STATUSES, day_statuses
    from pipeline.store.delta import open_table
    from pipeline.store.partitions import Lake
    from pipeline.store.records import last_day, read_records
    from schemas.calibrations import CALIBRATIONS
    from schemas.outcomes import OUTCOMES, OutcomeRow

    tables = Lake.existing(lake)
    open_table(
        tables, CALIBRATIONS
    )  # records that a release before 0.6 wrote are named, and how to move them
    last = to_day or last_day(tables, OUTCOMES)
    first = from_day or (None if last is None else _month_before(last))
    rows = read_records(tables, OUTCOMES, OutcomeRow, first=first, last=last)
    found = [s for s in day_statuses(rows) if method in (None, s.method) or not s.method]
    found = [s for s in found if vehicle in (None, s.vehicle)]
    if not json:
        _print_table(found)
    print_summary(
        "status",
        "done",
        lake=lake,
        first=first,
        last=last,
        vehicles=len({s.vehicle for s in found}),
        **{name: sum(s.status == name for s in found) for name in DAY_STATUSES},
        damaged=left_out(tables),
        **({"days": [asdict(s) for s in found]} if json else {}),
    )
    return 0


def _month_before(day: str) -> str:
    import datetime as dt

    from pipeline.errors import ConfigError

    try:
        return (dt.date.fromisoformat(day) - dt.timedelta(days=30)).isoformat()
    except ValueError as err:
        raise ConfigError("command line", "to", f"{day!r} is no day of the form YYYY-MM-DD") from err


def _print_table(days: Sequence[DayStatus]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from pipeline.fleet.status import DAY_STATUSES

    wanting = sorted((d for d in days if d.status != "done"), key=lambda d: DAY_STATUSES.index(d.status))
    table = Table("vehicle", "day", "status", "stage", "why")
    for day in wanting[:_ROWS]:
        # Text: names and reasons are not markup.
        table.add_row(*(Text(t) for t in (day.vehicle, day.day, day.status, day.stage, day.reason)))
    console = Console()
    if wanting:
        console.print(table)
    if len(wanting) > _ROWS:
        console.print(f"and {len(wanting) - _ROWS} more: --json lists them all")
    console.print(f"{len(days) - len(wanting)} of {len(days)} vehicle-days are done")

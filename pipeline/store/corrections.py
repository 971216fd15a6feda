"""Mistakes of fleet.toml or of the recording that vehicles' last days met, with what corrects them."""

from __future__ import annotations

from collections.abc import Mapping

import pyarrow.compute as pc

from pipeline.store.current import current_rows
from pipeline.store.partitions import Lake, days_after
from pipeline.store.records import last_day, read_columns
from schemas.outcomes import OUTCOMES

__all__ = ["correction_steps", "read_corrections"]

_DAYS = 31  # a vehicle whose last day is older than the lake's by this has driven nothing to correct
_NAMED = 3  # vehicles named before one correction


def read_corrections(lake: Lake, to_day: str | None = None) -> dict[str, str]:
    """What must be corrected by vehicle, if its last day of any night met a mistake of configuration.

    Args:
        to_day: last day to look at, YYYY-MM-DD; None = the last of any night.
    """
    last = to_day or last_day(lake, OUTCOMES)
    first = None if last is None else days_after(last, 1 - _DAYS)
    rows = read_columns(lake, OUTCOMES, ("faults", "reason"), first=first, last=last)
    if rows is None:
        return {}
    rows = current_rows(rows, OUTCOMES)
    ends = rows.group_by("vehicle").aggregate([("day", "max")])
    end_of = dict(zip(ends["vehicle"].to_pylist(), ends["day_max"].to_pylist(), strict=True))
    named = rows.filter(pc.greater(pc.list_value_length(rows["faults"]), 0))
    found: dict[str, str] = {}
    for row in named.select(["vehicle", "day", "faults", "reason"]).to_pylist():
        if "configuration" in row["faults"] and row["day"] == end_of[row["vehicle"]]:
            found.setdefault(row["vehicle"], row["reason"])
    return found


def correction_steps(mend: Mapping[str, str]) -> list[str]:
    """A sentence per correction, after the vehicles that wait for it."""
    waiting = {what: [v for v, own in mend.items() if own == what] for what in mend.values()}
    return [_step(what, vehicles) for what, vehicles in waiting.items()]


def _step(what: str, vehicles: list[str]) -> str:
    more = f" and {len(vehicles) - _NAMED} more" if len(vehicles) > _NAMED else ""
    return f"{', '.join(vehicles[:_NAMED])}{more}: {what}; then run the night again."

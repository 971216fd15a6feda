"""Mistakes of fleet.toml or of recording on vehicles' last days, with what corrects them; sign-off of states."""

from __future__ import annotations

from collections.abc import Mapping

import pyarrow.compute as pc

from pipeline.core.errors import ConfigError
from pipeline.store.commits import commit_records
from pipeline.store.current import current_rows
from pipeline.store.partitions import Lake, days_after, work_key
from pipeline.store.records import last_day, read_columns, read_records
from schemas.outcomes import OUTCOMES
from schemas.sign_offs import SIGN_OFFS, SignOff
from schemas.states import StateRow

__all__ = ["correction_steps", "read_corrections", "read_sign_offs", "sign"]

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


def read_sign_offs(lake: Lake, method: str, vehicle: str | None = None) -> list[SignOff]:
    """Sign-offs of states of a method, the oldest first."""
    found = sorted(read_records(lake, SIGN_OFFS, SignOff, vehicle=vehicle), key=lambda s: s.asserted_at)
    return [s for s in found if s.method == method]


def sign(lake: Lake, state: list[StateRow], name: str, note: str = "") -> None:
    """Record that a person approved a vehicle's state; ConfigError without a state or a name."""
    if not state or not name.strip():
        raise ConfigError(
            "command line", "sign-off", "needs a state of the vehicle, and the name of a person"
        )
    of, count = state[0], len(read_sign_offs(lake, state[0].method, state[0].vehicle))
    about = {"vehicle": of.vehicle, "day": of.day, "method": of.method, "state_key": of.work_key}
    key = work_key("sign-off", "", f"{of.vehicle} {count}", [of.work_key, name, note])  # a row each time
    commit_records(lake, SIGN_OFFS, [SignOff(**about, signed_by=name, note=note, work_key=key)])

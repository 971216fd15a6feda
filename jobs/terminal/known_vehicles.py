"""Vehicles of a lake, for commands that are given one by name."""

from __future__ import annotations

from difflib import get_close_matches

from pipeline.core.errors import ConfigError
from pipeline.store.partitions import Lake
from pipeline.store.records import read_columns
from schemas.calibrations import CALIBRATIONS
from schemas.outcomes import OUTCOMES
from schemas.states import STATES

__all__ = ["require_vehicle"]

_NAMED = 5  # vehicles of the lake named beside an unknown one


def require_vehicle(lake: Lake, vehicle: str) -> None:
    """Raise ConfigError for a vehicle without a day in the lake, unless rows that cannot be read may have one."""
    known: set[str] = set()
    for table in (CALIBRATIONS, OUTCOMES, STATES):
        rows = read_columns(lake, table, (), first=None, last=None)
        known |= set() if rows is None else set(rows["vehicle"].unique().to_pylist())
    if vehicle not in known and not any(rows.may_be_of(vehicle) for rows in lake.lost):
        like = get_close_matches(vehicle, sorted(known)) or sorted(known)[:_NAMED]
        problem = f"the lake has no day of {vehicle!r}; it has {', '.join(like) or 'no vehicle'}"
        raise ConfigError("command line", "vehicle", problem)

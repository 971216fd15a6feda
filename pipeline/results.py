"""What every stage returns, and how it says how far it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

__all__ = ["Outcome", "Progress", "silent"]

# progress(done, total, what): total 0 = unknown. Stages call it often; the job decides what a person sees.
Progress = Callable[[int, int, str], None]


def silent(done: int, total: int, what: str) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True)
class Outcome:
    """What became of one stage on one vehicle-day, or on the fleet (`vehicle` and `day` are empty then).

    `status`: "done", "cached" (same work key, nothing to do), "refused" (recorded with a reason; the fleet goes on),
    "failed" (an error; another try may help).
    """

    stage: str
    vehicle: str
    day: str
    status: str
    work_key: str
    rows: int = 0
    kept: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    reason: str = ""
    outputs: list[str] = field(default_factory=list)
    damaged: str = ""  # the file that could not be read, where that made it fail
    records: tuple[Any, ...] = field(
        default=(), repr=False
    )  # rows of a record table, those of a cached day too

    def counts(self) -> dict[str, Any]:
        """All but the status, the records and the damage, for a command's summary."""
        left_out = ("status", "records", "damaged")
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}

"""What every stage returns, and how it says how far it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

__all__ = ["Progress", "StageResult", "silent"]

# progress(done, total, what): total 0 = unknown. Stages call it often; the job decides what a person sees.
Progress = Callable[[int, int, str], None]


def silent(done: int, total: int, what: str) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True)
class StageResult:
    """Outcome of one stage on one vehicle-day.

    `status`: "done", "cached" (same work key, nothing to do), "refused" (recorded with a reason; the fleet goes on).
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

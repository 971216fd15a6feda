"""Counts of a night, added up as vehicle-days end, so that their records need not stay in memory."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from pipeline.core.results import Outcome
from pipeline.fleet.nightly import DayOutcome

__all__ = ["Tally"]


@dataclass
class Tally:
    """Counts of a night.

    Args:
        records: current calibration records, by pair and status.
        stages: by stage and status.
        seconds: by stage, of the workers; for audit, state and report, of the driver.
        bytes_read: by stage, page cache included.
    """

    vehicle_days: Counter[str] = field(default_factory=Counter)
    records: Counter[tuple[str, str]] = field(default_factory=Counter)
    stages: Counter[tuple[str, str]] = field(default_factory=Counter)
    seconds: Counter[str] = field(default_factory=Counter)
    bytes_read: Counter[str] = field(default_factory=Counter)
    bytes_written: Counter[str] = field(default_factory=Counter)

    def add(self, outcome: DayOutcome) -> None:
        """Count one vehicle-day."""
        self.vehicle_days[outcome.status] += 1
        self.records.update(outcome.pairs.items())
        for result in outcome.results:
            self.add_stage(result)

    def add_stage(self, result: Outcome) -> None:
        """Count one stage, of a vehicle-day or of the fleet."""
        effort = result.effort
        self.stages[result.stage, result.status] += 1
        self.seconds[result.stage] += effort.seconds  # type: ignore[assignment]  # a Counter adds what adds up
        self.bytes_read[result.stage] += effort.bytes_read or 0
        self.bytes_written[result.stage] += effort.bytes_written or 0

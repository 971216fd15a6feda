"""Metrics and lineage of a night, both optional. A failing sink is reported and does not fail the night."""

from __future__ import annotations

import datetime as dt
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from jobs.terminal.logging import logger

if TYPE_CHECKING:
    from pipeline.fleet.lineage import NightLineage
    from pipeline.fleet.lineage_sink import LineageSink
    from pipeline.fleet.nightly import DayOutcome, Night
    from pipeline.fleet.pattern import VehicleDay
    from pipeline.results import Outcome
    from schemas.drift import DriftFinding

__all__ = ["NightSinks", "night_sinks"]

_SENT_WITHIN_S = 30.0  # wait at most this long for unsent events after the night
_STOPPED_WITHIN_S = 2.0  # the same after an order to stop


class NightSinks:
    """Receives each vehicle-day as it ends, and the end of the night; None = no metrics, no lineage."""

    def __init__(
        self, night: Night, metrics: Path | None, lineage: tuple[NightLineage, LineageSink] | None
    ) -> None:
        from pipeline.fleet.tally import Tally

        self._night, self._metrics, self._lineage = night, metrics, lineage
        self._tally, self._began_s = Tally(), time.time()
        self._state = "ABORT"

    def take(self, outcome: DayOutcome) -> None:
        """Record a finished vehicle-day."""
        self._tally.add(outcome)
        if self._lineage is not None:
            lineage, sink = self._lineage
            for event in lineage.of_day(outcome):
                sink.emit(event)

    def take_stage(self, outcome: Outcome) -> None:
        """Record a finished stage of the whole fleet."""
        self._tally.add_stage(outcome)

    def ended(self, exit_code: int, findings: Sequence[DriftFinding]) -> None:
        """Record the exit code of the night and the findings of the audit."""
        from jobs.terminal.vehicle_status import count_statuses, moved_sensors

        self._state = "FAIL" if exit_code in (1, 2) else "COMPLETE"
        if self._metrics is None:
            return
        from pipeline.fleet.metrics import NightEnd, write_metrics

        moved = moved_sensors(findings)
        end = NightEnd(exit_code, self._began_s, time.time(), count_statuses(findings), moved)
        try:
            write_metrics(self._metrics, self._night.fleet.fleet.name, self._tally, end)
        except OSError as err:
            logger().warning("no metrics", file=str(self._metrics), reason=str(err))

    def close(self) -> None:
        """Send the end of the night, and wait until it is sent."""
        if self._lineage is None:
            return
        lineage, sink = self._lineage
        sink.emit(lineage.ended(dt.datetime.now(dt.UTC), self._state))
        problem = sink.close(_STOPPED_WITHIN_S if self._state == "ABORT" else _SENT_WITHIN_S)
        if problem:
            logger().warning("lineage is incomplete", reason=problem)


@contextmanager
def night_sinks(
    night: Night, days: Sequence[VehicleDay], metrics: Path | None, lineage: str | None
) -> Iterator[NightSinks]:
    """Open the sinks of a night: `metrics` is a file, `lineage` a file or a URL."""
    opened = None
    if lineage is not None:
        from pipeline.fleet.lineage import NightLineage
        from pipeline.fleet.lineage_sink import LineageSink

        opened = NightLineage.of(night, days), LineageSink(lineage)
        opened[1].emit(opened[0].begun(dt.datetime.now(dt.UTC)))
    sinks = NightSinks(night, metrics, opened)
    try:
        yield sinks
    finally:
        sinks.close()

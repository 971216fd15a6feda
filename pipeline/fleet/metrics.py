"""A night's counts: added up as vehicle-days end, and as a Prometheus text file for node_exporter (extra [ops])."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.core.results import Outcome
from pipeline.fleet.nightly import DayOutcome
from schemas.versions import CODE_VERSION
from schemas.words import DAY_WORDS

__all__ = ["NightEnd", "Tally", "write_metrics"]

_SUCCESS = (0, 3)  # held and refused days are valid results: a night with only those is a success
_LAST_SUCCESS = "last_success_timestamp_seconds"


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


@dataclass(frozen=True)
class NightEnd:
    """End of a night.

    Args:
        vehicles: number by status (GREEN, YELLOW, RED, UNKNOWN), after the audit.
        moved: vehicle, sensor and first day ("since") of each sensor that moved.
    """

    exit_code: int
    began_s: float
    ended_s: float
    vehicles: Mapping[str, int]
    moved: Sequence[Mapping[str, Any]]


def write_metrics(path: Path, fleet: str, tally: Tally, end: NightEnd) -> None:
    """Replace the file atomically; the time of the last successful night is kept if this night failed.

    Args:
        path: file NAME.prom, because node_exporter reads only this suffix; its folder must exist.

    Raises:
        OSError: the file cannot be written; it stays as it was.
    """
    from prometheus_client import CollectorRegistry, Gauge, write_to_textfile  # noqa: PLC0415 - an extra

    registry = CollectorRegistry()
    for name, what, labels, values in _gauges(fleet, path, tally, end):
        # All metrics are gauges: counts of different nights do not add up.
        gauge = Gauge(f"boresight_{name}", what, ("fleet", *labels), registry=registry)
        for of, value in sorted(values.items()):
            gauge.labels(fleet, *of).set(value)
    write_to_textfile(str(path), registry)


_Gauge = tuple[str, str, tuple[str, ...], Mapping[Any, int | float]]


def _gauges(fleet: str, path: Path, tally: Tally, end: NightEnd) -> Iterator[_Gauge]:
    """Name, meaning, labels, and values by label of every metric."""
    last = end.ended_s if end.exit_code in _SUCCESS else _last_success(path, fleet)
    days = {(s,): tally.vehicle_days[s] for s in ("cached", *DAY_WORDS) if s != "missing"}
    moved = {(m["vehicle"], m["sensor"], m["since"] or ""): 1 for m in end.moved}
    vehicles = {(status,): count for status, count in end.vehicles.items()}
    codes = "Exit code of the last night: 0, 1 failed, 2 misconfigured, 3 held or refused."
    records = "Current records of the last night's vehicle-days."
    yield "info", "Release that ran.", ("version",), {(CODE_VERSION,): 1}
    yield "last_run_timestamp_seconds", "When the last night ended.", (), {(): end.ended_s}
    if last is not None:
        yield _LAST_SUCCESS, "When the last night ended without a failure.", (), {(): last}
    yield "exit_code", codes, (), {(): end.exit_code}
    yield "duration_seconds", "Duration of the last night.", (), {(): end.ended_s - end.began_s}
    yield "vehicle_days", "Vehicle-days of the last night.", ("status",), days
    yield "records", records, ("pair", "status"), tally.records
    yield "vehicles", "Vehicles by status of the last audit.", ("status",), vehicles
    yield "sensor_moved", "1 for a sensor that moved.", ("vehicle", "sensor", "since"), moved
    yield "stage_ends", "Vehicle-days by how a stage ended.", ("stage", "status"), tally.stages
    for name, what, counts in (
        ("stage_seconds", "Workers' seconds in a stage.", tally.seconds),
        ("stage_read_bytes", "Bytes that workers read in a stage.", tally.bytes_read),
        ("stage_written_bytes", "Bytes that workers wrote in a stage.", tally.bytes_written),
    ):
        yield name, what, ("stage",), {(stage,): value for stage, value in counts.items()}


def _last_success(path: Path, fleet: str) -> float | None:
    """Time of the last success in the file; None if the file is missing or unreadable."""
    from prometheus_client.parser import text_string_to_metric_families  # noqa: PLC0415 - an extra

    try:
        for family in text_string_to_metric_families(path.read_text()):
            for sample in family.samples:
                if sample.name == f"boresight_{_LAST_SUCCESS}" and sample.labels.get("fleet") == fleet:
                    return float(sample.value)
    except (OSError, ValueError):
        return None
    return None

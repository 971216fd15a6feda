"""A night's counts: added up as vehicle-days end, and as a Prometheus text file for node_exporter (extra [ops])."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.results import Outcome
from pipeline.fleet.nightly import DayOutcome
from schemas.versions import CODE_VERSION
from schemas.words import DAY_WORDS

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

__all__ = ["NightEnd", "Tally", "write_metrics"]

_SUCCESS = (0, 3)  # held and refused days are valid results: a night with only those is a success
_LAST_SUCCESS = "boresight_last_success_timestamp_seconds"


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
    from prometheus_client import CollectorRegistry, write_to_textfile  # noqa: PLC0415 - an extra

    registry = CollectorRegistry()
    last = end.ended_s if end.exit_code in _SUCCESS else _last_success(path, fleet)
    _about_the_night(registry, fleet, tally, end, last)
    _about_stages(registry, fleet, tally)
    write_to_textfile(str(path), registry)


def _about_the_night(
    registry: CollectorRegistry, fleet: str, tally: Tally, end: NightEnd, last_success_s: float | None
) -> None:
    add = _Gauges(registry, fleet)
    add("boresight_info", "Release that ran.", {(CODE_VERSION,): 1}, ("version",))
    add("boresight_last_run_timestamp_seconds", "When the last night ended.", {(): end.ended_s})
    if last_success_s is not None:
        add(_LAST_SUCCESS, "When the last night ended without a failure.", {(): last_success_s})
    add(
        "boresight_exit_code",
        "Exit code of the last night: 0, 1 failed, 2 misconfigured, 3 held or refused.",
        {(): end.exit_code},
    )
    add("boresight_duration_seconds", "Duration of the last night.", {(): end.ended_s - end.began_s})
    days = {(s,): tally.vehicle_days[s] for s in ("cached", *DAY_WORDS) if s != "missing"}
    add("boresight_vehicle_days", "Vehicle-days of the last night.", days, ("status",))
    add(
        "boresight_records",
        "Current records of the last night's vehicle-days.",
        tally.records,
        ("pair", "status"),
    )
    vehicles = {(status,): count for status, count in end.vehicles.items()}
    add("boresight_vehicles", "Vehicles by status of the last audit.", vehicles, ("status",))
    moved = {(m["vehicle"], m["sensor"], m["since"] or ""): 1 for m in end.moved}
    add("boresight_sensor_moved", "1 for a sensor that moved.", moved, ("vehicle", "sensor", "since"))


def _about_stages(registry: CollectorRegistry, fleet: str, tally: Tally) -> None:
    add = _Gauges(registry, fleet)
    add("boresight_stage_ends", "Vehicle-days by how a stage ended.", tally.stages, ("stage", "status"))
    for name, what, counts in (
        ("boresight_stage_seconds", "Workers' seconds in a stage.", tally.seconds),
        ("boresight_stage_read_bytes", "Bytes that workers read in a stage.", tally.bytes_read),
        ("boresight_stage_written_bytes", "Bytes that workers wrote in a stage.", tally.bytes_written),
    ):
        add(name, what, {(stage,): value for stage, value in counts.items()}, ("stage",))


class _Gauges:
    """Adds gauges of one fleet. All metrics are gauges: counts of different nights do not add up."""

    def __init__(self, registry: CollectorRegistry, fleet: str) -> None:
        self._registry, self._fleet = registry, fleet

    def __call__(
        self,
        name: str,
        what: str,
        values: Mapping[Any, int | float],
        labels: Sequence[str] = (),
    ) -> None:
        from prometheus_client import Gauge  # noqa: PLC0415 - an extra

        gauge = Gauge(name, what, ("fleet", *labels), registry=self._registry)
        for of, value in sorted(values.items()):
            gauge.labels(self._fleet, *of).set(value)


def _last_success(path: Path, fleet: str) -> float | None:
    """Time of the last success in the file; None if the file is missing or unreadable."""
    from prometheus_client.parser import text_string_to_metric_families  # noqa: PLC0415 - an extra

    try:
        for family in text_string_to_metric_families(path.read_text()):
            for sample in family.samples:
                if sample.name == _LAST_SUCCESS and sample.labels.get("fleet") == fleet:
                    return float(sample.value)
    except (OSError, ValueError):
        return None
    return None

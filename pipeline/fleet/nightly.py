"""The night: every vehicle-day through the stages, then the audit of the fleet and the pages.

Each vehicle-day stands for itself: what cannot be calibrated becomes a refused record with its reason, what
fails is told in the outcome, and neither keeps the others waiting. Running the night again repeats only what
failed or whose inputs changed, because every stage answers "cached" to a work key that it knows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field

from pipeline.config import FleetConfig
from pipeline.errors import BoresightError
from pipeline.fleet.executor import EXECUTORS, Finished, Watch
from pipeline.fleet.pattern import VehicleDay
from pipeline.results import Progress, StageResult
from pipeline.stages import CALIBRATE, INGEST, PERCEIVE, Stage
from pipeline.store.current import current_records
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord

__all__ = ["DayOutcome", "Night", "run_night", "run_vehicle_day"]


@dataclass(frozen=True)
class Night:
    """What all vehicle-days of a night share."""

    fleet: FleetConfig
    lake: Lake
    method: str = "joint"
    seed: int | None = None


@dataclass(frozen=True)
class DayOutcome:
    """What became of a vehicle-day.

    `status`: "done", "cached" (nothing was to do), "held" or "refused" (a pair's record says so, or no record
    could be made), "failed" (something broke; another try may help).
    """

    vehicle: str
    day: str
    status: str
    reason: str = ""
    stages: dict[str, str] = field(default_factory=dict)
    pairs: dict[str, str] = field(default_factory=dict)
    frames: int = 0
    trace: str = ""


def run_night(
    night: Night, days: Sequence[VehicleDay], executor: str, workers: int, watch: Watch
) -> Iterator[DayOutcome]:
    """Outcome of every vehicle-day as it comes; vehicles that fleet.toml does not know are refused at once.

    Args:
        night: what the vehicle-days share.
        days: what is to be done.
        executor: a key of EXECUTORS.
        workers: processes at work at a time.
        watch: told what the i-th of the days known to fleet.toml is doing.
    """
    known = [d for d in days if d.partition.vehicle in night.fleet.vehicles]
    for unknown in (d.partition for d in days if d not in known):
        reason = f"{night.fleet.file} has no vehicle {unknown.vehicle!r}"
        yield DayOutcome(unknown.vehicle, unknown.day, "refused", reason)
    jobs = [(night, day) for day in known]
    with closing(EXECUTORS[executor](_run_job, jobs, workers, watch)) as results:
        for finished in results:
            yield _outcome(finished)


def run_vehicle_day(night: Night, work: VehicleDay, progress: Progress) -> DayOutcome:
    """Ingest, perceive and calibrate one vehicle-day; a stage's refusal ends as a refused record."""
    partition, done = work.partition, list[StageResult]()
    shared = (partition, night.fleet, night.lake)
    for stage, arguments, options in (
        (INGEST, (work.logs, *shared), {}),
        (PERCEIVE, shared, {}),
        (CALIBRATE, shared, {"method": night.method, "seed": night.seed}),
    ):
        try:
            done.append(stage.load()(*arguments, progress=_named(stage, progress), **options))
        except (BoresightError, OSError) as err:
            failed = StageResult(stage.name, partition.vehicle, partition.day, "failed", "", reason=str(err))
            return _summarise(night, partition, [*done, failed])
        if done[-1].status == "refused" and stage is not CALIBRATE:
            _record_refusal(night, partition, done[-1])
            break
    return _summarise(night, partition, done)


def _run_job(job: tuple[Night, VehicleDay], progress: Progress) -> DayOutcome:
    return run_vehicle_day(*job, progress)


def _named(stage: Stage, progress: Progress) -> Progress:
    return lambda done, total, what: progress(done, total, f"{stage.name} {what}")


def _outcome(finished: Finished[tuple[Night, VehicleDay], DayOutcome]) -> DayOutcome:
    if finished.value is not None:
        return finished.value
    partition = finished.item[1].partition
    return DayOutcome(partition.vehicle, partition.day, "failed", finished.error, trace=finished.trace)


def _record_refusal(night: Night, partition: Partition, refused: StageResult) -> None:
    """A record for a day that never reached the solver, so that whoever reads the lake finds the reason."""
    from pipeline.calibrate.records import Inputs, refused_records  # noqa: PLC0415 - brings the solver
    from pipeline.store.partitions import work_key  # noqa: PLC0415
    from pipeline.store.tables import write_records  # noqa: PLC0415
    from schemas.versions import CODE_VERSION  # noqa: PLC0415

    seed = night.fleet.solve.seed if night.seed is None else night.seed
    inputs = [refused.work_key] if refused.work_key else []
    key = work_key("refusal", CODE_VERSION, f"{refused.stage}: {refused.reason}", [*inputs, night.method])
    about = Inputs(partition, night.method, key, seed, tuple(inputs))
    records = refused_records(about, f"{refused.stage}: {refused.reason}", 0, None)
    write_records(night.lake, CALIBRATIONS, partition, records, key, CODE_VERSION, inputs)


def _summarise(night: Night, partition: Partition, results: Sequence[StageResult]) -> DayOutcome:
    pairs = _pairs(night, partition, results)
    worst = next((r for r in results if r.status in ("failed", "refused")), None)
    verdicts = {s for s in ("held", "refused") if s in pairs.values()}
    if worst is not None:
        status = worst.status
    elif verdicts:
        status = "held" if "held" in verdicts else "refused"
    else:
        status = "cached" if all(r.status == "cached" for r in results) else "done"
    return DayOutcome(
        partition.vehicle,
        partition.day,
        status,
        worst.reason if worst else next((r.reason for r in results if r.stage == CALIBRATE.name), ""),
        {r.stage: r.status for r in results},
        pairs,
        next((r.rows for r in results if r.stage == INGEST.name), 0),
    )


def _pairs(night: Night, partition: Partition, results: Sequence[StageResult]) -> dict[str, str]:
    """Status of the day's current record of each pair, where this night came as far as calibrate."""
    if not results or results[-1].stage != CALIBRATE.name or results[-1].status == "failed":
        return {}
    found = read_records(
        night.lake, CALIBRATIONS, CalibrationRecord, vehicle=partition.vehicle, day=partition.day
    )
    key = results[-1].work_key
    return {r.pair: r.status for r in current_records([r for r in found if r.work_key == key])}

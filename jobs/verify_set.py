"""`boresight verify-set`: judge the calibrations that a data set ships, over all of its logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from jobs.convert import DataSet

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.convert.recording import Recording
    from pipeline.fleet.pattern import VehicleDay
    from pipeline.store.partitions import Lake
    from pipeline.verify.log_set import LogJob, SetSettings
    from schemas.set_checks import SetCheck

__all__ = ["verify_set"]


# The parameters of a command are its options: more than eight, because a user sets each of them.
def verify_set(
    data_set: DataSet | None = None,
    folder: Path | None = None,
    /,
    *,
    out: Path,
    fleet: Path | None = None,
    logs: str | None = None,
    segmenter: Path | None = None,
    detector: Path | None = None,
    claims: Path | None = None,
    per: Literal["log", "day"] = "log",
    turns: int = 4,
    faults: int = 1,
    sizes: Annotated[tuple[float, ...], Parameter(consume_multiple=True)] = (0.5, 1.0, 2.0),
    camera_lidar_deg: float = 0.5,
    radar_deg: float = 1.0,
    frames: int = 100,
    executor: Literal["process", "inline", "ray"] = "process",
    workers: int | None = None,
) -> int:
    """Judge the calibrations that a data set ships: right, wrong or undecided per log and sensor.

    The calibration of every log is checked as by `verify`, and again with known turns: the page gives the
    share of turns that are called wrong. A stopped run continues from its recorded rows. Exit code 0: every
    sensor of every log is right; 1: a log could not be read; 3: a sensor is wrong or undecided, or a claim is
    refuted or does not count.

    Args:
        data_set: nuscenes, vod or kitti, followed by its folder; drives are converted one by one during the
            run.
        folder: folder of the data set.
        fleet: instead of a data set: fleet.toml; a log ships its tf_static, or the file that fleet.toml
            names.
        logs: with --fleet: pattern such as "logs/{vehicle}/{day}/*.mcap"; quoted.
        out: folder for set.html, set_checks.parquet and rows recorded during the run.
        segmenter: model manifest for the data set's images; without models its cameras are undecided.
        detector: model manifest of a detector; `boresight models fetch` downloads both.
        claims: TOML file with [[claims]], registered with its hash before the first log is opened.
        per: log: each log alone; day: the logs of a vehicle-day together.
        turns: known turns per log; sensors, axes and sizes alternate over the logs of the set.
        faults: known faults per log, as shifted labels or a wrong CameraInfo; they alternate too.
        sizes: sizes of the turns, as multiples of --camera-lidar-deg or --radar-deg.
        camera_lidar_deg: an axis passes only if an error of this size would have been detected.
        radar_deg: the same limit for pairs with the radar.
        frames: number of frames of a log to use.
        executor: process, inline or ray, as for `nightly`.
        workers: processes or tasks at a time; default: one per CPU.
    """
    from jobs.extras import require
    from jobs.terminal.summary import print_summary
    from pipeline.config import load_fleet
    from pipeline.errors import ConfigError
    from pipeline.extrinsics.prior import require_named_files
    from pipeline.stages import CALIBRATE, INGEST, PERCEIVE
    from pipeline.store.partitions import Lake
    from pipeline.store.records import read_records
    from pipeline.verify.claims import judged_claims, register
    from pipeline.verify.log_set import SetSettings
    from pipeline.verify.one_log import for_one_look
    from pipeline.verify.rates import looks_of
    from pipeline.verify.together import one_verdict_each
    from schemas.set_checks import SET_CHECKS, SetCheck

    if executor == "ray":
        require("ray")
    if min(turns, faults) < 0 or not all(size > 0 for size in sizes) or (workers is not None and workers < 1):
        problem = "--turns and --faults are at least 0, --sizes are above 0, --workers is at least 1"
        raise ConfigError("command line", "--turns, --faults, --sizes, --workers", problem)
    fleet, days = _source(data_set, folder, fleet, logs, out, (segmenter, detector))
    config = load_fleet(fleet)
    require_named_files(config)
    config = for_one_look(config.read_from(fleet.resolve()), frames)
    stages = (INGEST.run, PERCEIVE.run, CALIBRATE.run)
    settings = SetSettings(config, (camera_lidar_deg, radar_deg), sizes, turns, faults, stages)
    tables = Lake.at(out)
    before = read_records(tables, SET_CHECKS, SetCheck)
    registered = register(out / "claims.json", claims, len({r.log for r in before}))
    jobs, copies = _jobs(settings, days, per, before)
    rows = _ask(settings, jobs, tables, executor, workers)
    together = one_verdict_each(rows, config.verify.confidence)
    looks = looks_of(rows)
    judged = judged_claims(registered, looks)
    blind = data_set is not None and segmenter is None
    note = (
        "No --segmenter and --detector were given: without labels no camera can be judged." if blind else ""
    )
    told = _summary(rows, looks, looks_of(together)) | {"copies": copies, "note": note}
    _write(out, config.fleet.name, [*rows, *together], told, judged)
    verdicts = [c["verdict"] for c in judged]
    is_right = set(told["answers"]) == {"right"} and not told["no_answer"]
    is_held = set(verdicts) <= {"holds", "not tested"}
    code = 1 if told["no_answer"].get("unreadable") else 0 if is_right and is_held else 3
    status = {0: "right", 1: "failed", 3: "wrong" if "wrong" in told["answers"] else "inconclusive"}[code]
    claimed = {v: verdicts.count(v) for v in dict.fromkeys(verdicts)}
    print_summary("verify-set", status, **told, claims=claimed, page=out / "set.html")
    return code


def _source(
    data_set: DataSet | None,
    folder: Path | None,
    fleet: Path | None,
    logs: str | None,
    out: Path,
    models: tuple[Path | None, Path | None],
) -> tuple[Path, Sequence[VehicleDay | LogJob]]:
    """fleet.toml and vehicle-days, or the drives of a data set with a fleet.toml that is written for them."""
    from jobs.convert import models_of, recordings_of, write_fleet
    from pipeline.errors import ConfigError
    from pipeline.fleet.pattern import find_vehicle_days

    if data_set is None and fleet is not None and logs is not None:
        if models != (None, None):
            raise ConfigError(
                "command line", "--segmenter, --detector", "fleet.toml names the models of logs"
            )
        return fleet, find_vehicle_days(logs)
    if data_set is None or folder is None or fleet is not None or logs is not None:
        problem = "give a data set and its folder, or --fleet and --logs"
        raise ConfigError("command line", "DATA-SET FOLDER", problem)
    named = models_of(*(None if m is None else str(m.resolve()) for m in models))
    recordings = recordings_of(data_set, folder, str(data_set), "2000-01-01", {})
    return write_fleet(out, data_set, recordings, named), [_job_of(folder, r) for r in recordings]


def _job_of(folder: Path, recording: Recording) -> LogJob:
    """A drive of a data set, known by its calibration and stamps."""
    import hashlib
    from functools import partial

    from pipeline.convert.log_file import write_log
    from pipeline.verify.log_set import LogJob

    cameras = {n: (c.K.tolist(), c.D.tolist()) for n, c in recording.cameras.items()}
    told = {n: T.tolist() for n, T in recording.T_base.items()}, cameras
    stamps = [(e.stamp_ns, e.sensor) for e in recording.events]
    identity = hashlib.sha256(repr((recording.vehicle, recording.name, told, stamps)).encode()).hexdigest()
    log = folder / recording.name
    make = partial(write_log, recording=recording)
    return LogJob(recording.vehicle, recording.day, (log,), identity, make=make)


def _jobs(
    settings: SetSettings, days: Sequence[VehicleDay | LogJob], per: str, before: Sequence[SetCheck]
) -> tuple[list[LogJob], list[str]]:
    """Work per log or vehicle-day, with what is recorded of it; and logs that are copies of others."""
    import hashlib
    from collections import defaultdict
    from dataclasses import replace

    from pipeline.errors import BoresightError
    from pipeline.ingest.containers.reader import content_identity
    from pipeline.verify.log_set import LogJob, key_of_log

    done = defaultdict(list)
    for row in before:
        done[row.work_key].append(row)
    found: dict[str, LogJob] = {}
    copies = []

    def add(job: LogJob) -> None:
        key = key_of_log(settings, job) if settings.fleet.knows(job.vehicle) else ""
        found[job.identity] = replace(job, key=key, done=tuple(done[key]) if key else ())

    for day in days:
        if isinstance(day, LogJob):
            add(day)
            continue
        for logs in [day.logs] if per == "day" else [(log,) for log in day.logs]:
            own = tuple(Path(log).absolute() if isinstance(log, Path) else log for log in logs)
            try:
                said = "".join(map(content_identity, own))
            except (BoresightError, OSError):
                said = str(own[0])  # nobody can read it: its row will say so
            content = hashlib.sha256(said.encode()).hexdigest()
            if content in found:
                copies.append(str(own[0]))
                continue
            add(LogJob(day.partition.vehicle, day.partition.day, own, content))
    return list(found.values()), copies


def _ask(
    settings: SetSettings, jobs: Sequence[LogJob], tables: Lake, executor: str, workers: int | None
) -> list[SetCheck]:
    """Rows of all logs; completely recorded logs are not checked again."""
    from jobs.terminal.night_view import night_view
    from pipeline.fleet.executor import EXECUTORS
    from pipeline.verify.log_set import ask_set, is_complete

    rows = [row for job in jobs if is_complete(settings, job) for row in job.done]
    todo = [job for job in jobs if not is_complete(settings, job)]
    names = {job.identity: f"{job.vehicle}/{job.logs[0].name} {job.day}" for job in todo}
    with night_view(list(names.values()), len(todo), "verify-set") as view:
        for job, own in ask_set(settings, todo, tables, EXECUTORS[executor], workers, view.watch):
            rows += own
            view.ended(names[job.identity])
    return sorted(rows, key=lambda r: (r.vehicle, r.day, r.log, r.turn, r.sensor, r.axis))


def _summary(rows: Sequence[SetCheck], looks: Sequence[Any], together: Sequence[Any]) -> dict[str, Any]:
    from collections import Counter

    from pipeline.verify.rates import by_fault, by_sensor, by_shipped, by_turn

    silent = [r for r in rows if not r.sensor]
    return {
        "logs": len({(r.vehicle, r.day, r.log) for r in rows}),
        "answers": dict(Counter(k.row.answer for k in looks if not k.row.turn)),
        "no_answer": dict(Counter(r.answer for r in silent)),
        "named": [{"log": r.log, "answer": r.answer, "reason": r.reason} for r in silent],
        "sensors": by_sensor(looks),
        "shipped": by_shipped(looks),
        "turns": by_turn(looks),
        "faults": by_fault(looks),
        "together": [_verdict_of(k) for k in together if not k.row.turn],
        "turns_together": by_turn(together),
    }


def _verdict_of(look: Any) -> dict[str, Any]:
    """One verdict of several logs: answer, and each axis."""
    import math

    def deg(value: float | None) -> float | None:
        return None if value is None else math.degrees(value)

    axes = {
        c.axis: {"off_deg": deg(c.signed_rad), "sigma_deg": deg(c.sigma_rad), "limit_deg": deg(c.limit_rad)}
        | {"asked_deg": deg(c.asked_rad), "power": c.power or 0.0, "status": c.status, "reason": c.reason}
        | {"logs": c.fused_used}
        for c in look.axes
    }
    about = {name: getattr(look.row, name) for name in ("vehicle", "rig", "shipped", "sensor", "answer")}
    return about | {"logs": look.row.log, "axes": axes}


def _write(
    out: Path, name: str, rows: Sequence[SetCheck], told: dict[str, Any], claims: list[dict[str, Any]]
) -> None:
    """Write the table as one Parquet file, and the page."""
    import pyarrow.parquet as pq

    from pipeline.report.log_set import log_set_page
    from pipeline.report.page import write_page
    from pipeline.store.atomic_write import atomic_write
    from pipeline.store.rows import to_table
    from schemas.set_checks import SET_CHECKS

    out.mkdir(parents=True, exist_ok=True)
    with atomic_write(out / "set_checks.parquet") as stream:
        pq.write_table(to_table(rows, SET_CHECKS), stream)
    shipped = [row for row in rows if not row.turn and row.sensor and not row.fused]
    write_page(out / "set.html", log_set_page(name, told, shipped, claims))

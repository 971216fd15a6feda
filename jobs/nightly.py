"""`boresight nightly`: a fleet's logs to records, drift findings and pages."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path, PurePath
from typing import Annotated, Literal

from cyclopts import Parameter

from jobs.extras import require
from jobs.terminal.logging import logger
from jobs.terminal.night_view import night_view
from jobs.terminal.summary import exit_code, left_out, print_summary, problems_of, progress_reporter
from jobs.terminal.vehicle_status import count_statuses, moved_sensors, next_steps, told_of
from pipeline.calibrate.methods import method_named
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.core.results import Outcome
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT, REPORT, STATE
from pipeline.fleet.executor import OnWorkers
from pipeline.fleet.metrics import NightEnd, Tally, write_metrics
from pipeline.fleet.nightly import DayOutcome, Night, plan_night, refused_at_once, run_night
from pipeline.fleet.pattern import VehicleDay, find_logs
from pipeline.fleet.status import night_statuses, night_word, to_mend, vehicles_to_mend
from pipeline.report.stage import Pages
from pipeline.rig.day_prior import require_named_files
from pipeline.store.delta import tidy_table
from pipeline.store.files import LocalFiles
from pipeline.store.partitions import Lake, Partition
from schemas.drift import DRIFT, DriftFinding
from schemas.versions import TABLES
from schemas.words import DAY_WORDS

__all__ = ["close_night", "nightly", "watch_night"]


# The parameters of a command are its options: more than eight, because a user sets each of them.
def nightly(
    *,
    fleet: Path,
    lake: str,
    logs: str,
    from_day: Annotated[str | None, Parameter(name="--from")] = None,
    to_day: Annotated[str | None, Parameter(name="--to")] = None,
    executor: Literal["process", "inline", "ray"] = "process",
    workers: int | None = None,
    method: str | None = None,
    seed: int | None = None,
    report: Path | None = None,
    pictures: bool = True,
    metrics: Path | None = None,
    held_exit_code: Literal[0, 3] = 3,
    dry_run: bool = False,
) -> int:
    """Run all stages on every vehicle-day whose logs match a pattern; a failed day never stops the fleet.

    Args:
        fleet: fleet.toml.
        lake: folder of the tables, created if missing.
        logs: pattern such as "logs/{vehicle}/{day}/*" or "data/{vehicle}_{day}_*"; quoted.
            In a bucket: "s3://BUCKET/{vehicle}/{day}/*.mcap".
        from_day: first day, YYYY-MM-DD.
        to_day: last day.
        executor: process (a pool), inline (one after the other in this process) or ray (tasks of the cluster
            in RAY_ADDRESS, otherwise of this machine; needs the extra [ray]).
        workers: processes or tasks at a time; default: one per CPU that this process may use, two per CPU of
            a cluster.
        method: calibration method; default: audit.method, so that calibration and audit use the same.
        seed: random seed; default: the seed of the configuration.
        report: HTML page of the fleet; default: report/fleet.html in the lake.
        pictures: --no-pictures draws pages without images of public roads.
        metrics: Prometheus text file to replace at the end of the night; needs the extra [ops].
        held_exit_code: exit code if something was held or refused; 0 for schedulers that treat any other code
            as failure.
        dry_run: only list what would run, and why.
    """
    for extra, is_asked in (("ray", executor == "ray"), ("ops", metrics)):
        if is_asked:
            require(extra)
    config = load_fleet(fleet)
    require_named_files(config)
    tables = Lake.at(lake)
    night = Night(config, tables, method_named(method or config.audit.method).name, seed)
    days, left_out_logs = find_logs(logs, from_day, to_day)
    if left_out_logs:
        logger().warning(left_out_logs)
    if dry_run:
        return _print_plan(night, days, left_out_logs)
    tally, began_s = Tally(), time.time()
    outcomes = watch_night(night, days, executor, workers, tally.add)
    files = tables.files if report is None else LocalFiles()
    pages = Pages(
        report or tables.root / "report" / "fleet.html",
        pictures=pictures,
        files=files,
        fan_out=OnWorkers(executor, workers),
    )
    findings, drawn = close_night(night, to_day, pages, outcomes, tally.add_stage) if outcomes else ([], [])
    for schema in TABLES.values():
        for what in tidy_table(tables, schema) if schema.is_record_table else ():
            logger().info("tidied", table=schema.name, what=what)
    code = exit_code([*night_statuses(outcomes, config), *(["incomplete"] if tables.damage else [])])
    if metrics is not None:
        _write_metrics(metrics, config.fleet.name, tally, code, began_s, findings)
    steps = next_steps(findings, str(tables), vehicles_to_mend(outcomes, config))
    print_summary(
        "nightly",
        {0: "done", 1: "failed", 2: "failed", 3: night_word(o.status for o in outcomes)}[code],
        vehicle_days=len(outcomes),
        **{s: sum(o.status == s for o in outcomes) for s in ("cached", *DAY_WORDS) if s != "missing"},
        problems=problems_of(outcomes, "vehicle", "day", "status", "reason", "pairs"),
        **told_of(findings),
        misconfigured=to_mend(outcomes, config),
        logs_left_out=left_out_logs,
        next_steps=[left_out_logs, *steps] if left_out_logs else steps,
        damaged=left_out(tables),
        report=drawn[0] if drawn else None,
    )
    return held_exit_code if code == 3 else code


def _write_metrics(
    file: Path, fleet: str, tally: Tally, code: int, began_s: float, findings: Sequence[DriftFinding]
) -> None:
    """Write the metrics; the log names a file that cannot be written, and the night goes on."""
    end = NightEnd(code, began_s, time.time(), count_statuses(findings), moved_sensors(findings))
    try:
        write_metrics(file, fleet, tally, end)
    except OSError as err:
        logger().warning("no metrics", file=str(file), reason=str(err))


def _print_plan(night: Night, days: Sequence[VehicleDay], left_out_logs: str) -> int:
    """Print what the night would do with each vehicle-day, as a table and as the summary."""
    plans = list(plan_night(night, days))
    for plan in plans:
        sys.stderr.write(f"{plan.vehicle} {plan.day}: {', '.join(plan.stages) or 'nothing'} ({plan.why})\n")
    print_summary(
        "nightly",
        "planned",
        vehicle_days=len(plans),
        would_run=sum(bool(p.stages) for p in plans),
        logs_left_out=left_out_logs,
        damaged=left_out(night.lake),
        plan=[asdict(p) for p in plans],
    )
    return 0


def watch_night(
    night: Night,
    days: Sequence[VehicleDay],
    executor: str,
    workers: int | None,
    take: Callable[[DayOutcome], None] = lambda _: None,
) -> list[DayOutcome]:
    """Run the night with a progress display; returns outcomes as they complete, without records.

    `take` receives each complete outcome.
    """
    if workers is not None and workers < 1:
        raise ConfigError("command line", "--workers", f"{workers} is less than one")
    known = [d.partition for d in days if not refused_at_once(night, d.partition)]
    outcomes = []
    with night_view([f"{p.vehicle} {p.day}" for p in known], len(days)) as view:
        for outcome in run_night(night, days, executor, workers, view.watch):
            view.finished(outcome)
            take(outcome)
            # Without records: those of a whole fleet would not fit in memory.
            outcomes.append(replace(outcome, results=()))
    return outcomes


def close_night(
    night: Night,
    to_day: str | None,
    pages: Pages,
    outcomes: Sequence[DayOutcome],
    told: Callable[[Outcome], None] = lambda _: None,
) -> tuple[list[DriftFinding], list[str]]:
    """Audit the fleet, compute vehicle states, and write the pages; returns the findings and the page paths.

    The charts cover the last `audit.window_days` days, however few days this night processed. Days of this
    night get a page however old they are. `told` receives the outcome of each of these stages.
    """
    task = Task(night.fleet, night.lake, Window(None, to_day), night.method)
    with progress_reporter("audit") as progress:
        audit, state = (stage.run(replace(task, progress=progress)) for stage in (AUDIT, STATE))
    told(audit)
    told(state)
    findings = DRIFT.rows_among(audit.records)
    if not findings:
        return [], []
    pages = replace(pages, also=[Partition(o.vehicle, o.day) for o in outcomes if o.pairs])
    with progress_reporter("report") as progress:
        progress(0, 0, "pages")
        report = REPORT.run(replace(task, of=Window(), given=pages, progress=progress))
    told(report)
    return findings, [pages.files.uri(PurePath(path)) for path in report.outputs]

"""`boresight audit`: control charts over the days of a fleet."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jobs.terminal.summary import exit_code, left_out, print_summary, progress_reporter
from jobs.terminal.vehicle_status import next_steps, told_of
from pipeline.calibrate.methods import method_named
from pipeline.core.config import load_fleet
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT, REPORT, STATE
from pipeline.report.stage import Pages
from pipeline.store.corrections import read_corrections
from pipeline.store.partitions import Lake
from schemas.drift import DRIFT, DRIFT_STATUSES

__all__ = ["audit"]


def audit(
    *,
    fleet: Path,
    lake: str,
    from_day: Annotated[str | None, Parameter(name="--from")] = None,
    to_day: Annotated[str | None, Parameter(name="--to")] = None,
    method: str | None = None,
    report: Path | None = None,
) -> int:
    """Find out which sensor of which vehicle moved, on which day and by how much.

    Args:
        fleet: fleet.toml; section [audit] sets limits and the false-alarm budget.
        lake: folder of the tables.
        from_day: first day of the window, YYYY-MM-DD; default: audit.window_days before the last day.
        to_day: last day of the window; default: the last day with a record.
        method: calibration method of the audited records; default: audit.method.
        report: fleet page to write as well, with a page per vehicle-day in a folder next to it.
    """
    if method is not None:
        method_named(method)
    config = load_fleet(fleet)
    tables = Lake.existing(lake)
    with progress_reporter("audit") as progress:
        task = Task(config, tables, Window(from_day, to_day), method, progress=progress)
        outcome = AUDIT.run(task)
        STATE.run(task)
    findings = DRIFT.rows_among(outcome.records)
    charts = [f.status for f in findings]
    mend = read_corrections(tables, to_day)
    outputs = []
    if report is not None:
        with progress_reporter("report") as progress:
            task = Task(config, tables, Window(), method, given=Pages(report), progress=progress)
            outputs = REPORT.run(task).outputs
    damaged = left_out(tables)
    status = "incomplete" if damaged and outcome.status in ("done", "cached") else outcome.status
    print_summary(
        "audit",
        status,
        reason=outcome.reason,
        vehicles=len({f.vehicle for f in findings}),
        charts={s: charts.count(s) for s in DRIFT_STATUSES},
        **told_of(findings),
        next_steps=next_steps(findings, lake, mend),
        misconfigured=mend,
        damaged=damaged,
        report=report,
        outputs=outputs,
    )
    return exit_code([status])

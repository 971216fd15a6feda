"""`boresight demo`: a synthetic fleet with one knocked radar, from logs to a report."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from jobs.extras import require
from jobs.nightly import close_night, watch_night
from jobs.simulate import simulate_days
from jobs.terminal.demo_table import errors_of, print_comparison
from jobs.terminal.summary import exit_code, is_terminal, print_summary
from jobs.terminal.vehicle_status import told_of
from pipeline.core.config import config_hash, load_fleet
from pipeline.fleet.executor import OnWorkers
from pipeline.fleet.nightly import DayOutcome, Night
from pipeline.fleet.pattern import find_vehicle_days
from pipeline.report.stage import Pages
from pipeline.report.truth import read_truth
from pipeline.store.partitions import Lake
from schemas.versions import CODE_VERSION

if TYPE_CHECKING:
    from pipeline.simulate.fleet import FleetSpec

__all__ = ["demo"]

# Methods compared with the truth at the end: the night's method, and the included network.
_NETWORK = "joint-ssl"
# The radar of the second vehicle is turned before the third day. A kerb or a car wash can turn it by 1.2 deg.
_KNOCK = "vehicle-2:2:radar:yaw:1.2"
# Vehicles with other sensors than the first: the rig `duo` has two cameras and two radars. Its additional
# edges take more time; fewer moments compensate for that.
_OWN_RIGS = (("vehicle-3", "duo"),)
_FEWEST = 12


def demo(
    *,
    out: Path = Path("demo"),
    vehicles: int = 3,
    days: int = 4,
    frames: int = 60,
    workers: int | None = None,
    seed: int = 1,
) -> int:
    """Simulate vehicles for some days, turn one radar, find the change, and write the report.

    Args:
        out: folder for logs, truth, lake and report; results that are up to date are kept.
        vehicles: number of vehicles; the radar of the second one is turned.
        days: number of days; the radar is turned before the third.
        frames: moments per vehicle and day; three quarters of them for the third vehicle, which has more
            sensors.
        workers: processes at a time; default: one per CPU that this process may use.
        seed: random seed of the fleet.
    """
    require("simulate")
    began = time.monotonic()
    spec, dates = _plan(vehicles, days, frames, seed)
    bump = "; before day 3 someone bumps a radar" if spec.faults else ""
    _say(f"[bold]1/3[/]  vehicles: {vehicles}, days: {days}{bump}")
    _simulate(spec, out, workers)
    night = Night(load_fleet(out / "fleet.toml"), Lake.at(out / "lake"))
    _say("[bold]2/3[/]  the night: ingest, perceive, calibrate every vehicle-day")
    outcomes = _calibrate(night, out / "logs", dates, workers)
    _say("[bold]3/3[/]  the audit: which sensor moved, and since when")
    truth = read_truth(out / "truth")
    pages = Pages(out / "report" / "fleet.html", truth, fan_out=OnWorkers("process", workers))
    findings, drawn = close_night(night, None, pages, outcomes)
    print_comparison(night.lake, night.method, truth, dates[-1], findings)
    methods = (night.method, _NETWORK)
    errors = [error for m in methods for error in errors_of(night.lake, m, truth, dates[-1])]
    (out / "comparison.json").write_text(json.dumps(errors, indent=1) + "\n")
    knocked = [{"vehicle": f.vehicle, "sensor": f.sensor, "since": dates[f.day]} for f in spec.faults]
    page, seconds = drawn[0] if drawn else None, round(time.monotonic() - began, 1)
    _say(f"\n[bold]{page or 'no report'}[/]  open it in a browser ({seconds:.0f} s in all)")
    code = exit_code(o.status for o in outcomes)
    print_summary(
        "demo",
        {0: "done", 1: "failed", 3: "held"}[code],
        report=page,
        seconds=seconds,
        vehicle_days=vehicles * days,
        knocked=knocked,
        comparison=out / "comparison.json",
        **told_of(findings),
    )
    return code


def _plan(vehicles: int, days: int, frames: int, seed: int) -> tuple[FleetSpec, list[str]]:
    """The fleet to simulate, with the turned radar, and its days."""
    from pipeline.simulate.faults import parse_faults
    from pipeline.simulate.fleet import FleetSpec, day_names

    base = FleetSpec(
        vehicles=vehicles,
        days=days,
        frames=frames,
        seed=seed,
        container="mixed",
        own_rigs=_OWN_RIGS,
        own_frames=max(frames * 3 // 4, _FEWEST),
    )
    dates = day_names(base.first_day, days)
    knocks = _KNOCK if vehicles > 1 and days > 2 else ""
    return replace(base, faults=parse_faults(knocks, dates)), dates


def _calibrate(night: Night, logs: Path, dates: Sequence[str], workers: int | None) -> list[DayOutcome]:
    """Calibrate every vehicle-day by the night's method, and the last day by the network too."""
    work = find_vehicle_days(str(logs / "{vehicle}" / "{day}" / "*"), dates[0], dates[-1])
    # The network needs one camera, one lidar and one radar, and works on single frames without semantics.
    others = dict(_OWN_RIGS)
    last_day = [w for w in work if w.partition.day == dates[-1] and w.partition.vehicle not in others]
    by_network = replace(night, method=_NETWORK)
    return [
        *watch_night(night, work, "process", workers),
        *watch_night(by_network, last_day, "process", workers),
    ]


def _simulate(spec: FleetSpec, out: Path, workers: int | None) -> None:
    """Write the fleet's logs, unless the folder contains the same fleet already."""
    stamp, key = out / ".simulated", config_hash({"spec": repr(spec), "code": CODE_VERSION})
    if stamp.is_file() and stamp.read_text() == key:
        return
    stamp.unlink(missing_ok=True)
    for folder in ("logs", "truth"):
        shutil.rmtree(out / folder, ignore_errors=True)
    simulate_days(spec, out, "demo", workers)
    stamp.write_text(key)


def _say(text: str) -> None:
    """Print a line on a terminal; without a terminal, the log has the same information."""
    if is_terminal():
        Console(stderr=True, highlight=False).print(text)

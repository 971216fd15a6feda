"""The engine of all studies: runs that are not yet in the JSON Lines file, on days perceived before, one line each.

A study is a list of `Run`s and a summary. A run names a day, how its prior is made, the method and changes of the
configuration; its key is all of that, so a study that was stopped goes on where it stood. A line counts only where the
same code made it (`--accept-commits` lets others count), and every table says whether its seeds were seen before.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, fields, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibrate.records import Inputs
from pipeline.core.config import SolveConfig
from pipeline.core.errors import SolveError
from pipeline.rig.day_prior import read_prior
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from pipeline.rig.targets import loop_errors
from pipeline.store.current import transform_of
from pipeline.store.partitions import Partition
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.commits import commit_now, is_accepted
from tests.benchmarks.studies.days import DATE, VEHICLE, Day, DaySpec, generated_day
from tests.benchmarks.studies.looks import look
from tests.benchmarks.studies.metrics import measure, mounting_error
from tests.makers.calibrated_days import perturbed, records_of_rows

__all__ = ["RESULTS", "Run", "boresight", "calibrate_once", "run_study"]

# The default sigmas of `rigs.*.prior` in fleet.toml: what a user has who says nothing.
ROTATION_SIGMA_DEG, TRANSLATION_SIGMA_M = 2.0, 0.05
RESULTS = Path("tests/benchmarks/results")


@dataclass(frozen=True)
class Run:
    """One calibration of a study.

    `prior` is how the prior differs from truth: ("exact", deg, m) turns and shifts both transforms by exactly so much
    in random directions, and its sigmas allow for it; ("drawn", deg, m) draws every angle and shift from the normal
    distribution that its sigmas state; ("logged", deg, m) is tf_static with these sigmas. `solve` replaces fields of
    the configuration.
    """

    day: DaySpec
    method: str = "joint"
    prior: tuple[str, float, float] = ("drawn", ROTATION_SIGMA_DEG, TRANSLATION_SIGMA_M)
    seed: int = 0
    solve: dict[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """What tells this run from all others."""
        return key_of(asdict(self))


def key_of(result: dict[str, Any]) -> str:
    """Key of the run that a result line stands for."""
    return json.dumps({f.name: result[f.name] for f in fields(Run)}, sort_keys=True)


def prior_of(day: Day, how: tuple[str, float, float], seed: int) -> Prior:
    """The prior of a run (see `Run`)."""
    kind, deg, shift_m = how
    stated = (float(np.radians(deg)), shift_m)
    if kind == "logged":
        logged = read_prior(day.rows, day.fleet, next(iter(day.fleet.vehicles)))
        return Prior(logged.T_camera_lidar, logged.T_lidar_radar, *stated)
    true = day.true_of("camera_lidar"), day.true_of("lidar_radar")
    if kind == "exact":
        default = (float(np.radians(ROTATION_SIGMA_DEG)), TRANSLATION_SIGMA_M)
        return perturbed(Prior(*true, *default), (deg, shift_m), seed)
    rng = np.random.default_rng([seed, 7])
    drawn = [
        from_rotation_translation(
            exp_so3(rng.normal(0, stated[0], 3)) @ T[:3, :3], T[:3, 3] + rng.normal(0, shift_m, 3)
        )
        for T in true
    ]
    return Prior(drawn[0], drawn[1], *stated)


def search_range(how: tuple[str, float, float]) -> dict[str, float]:
    """`solve.search_*` that contain the prior's error, as its user would set them: 4 sigmas, or 1.2 times an exact one.

    Never less than the defaults, and these where nobody knows that the prior is off.
    """
    factor = {"drawn": 4.0, "exact": 1.2}.get(how[0], 0.0)
    default = SolveConfig()
    return {
        "search_rotation_deg": max(default.search_rotation_deg, factor * how[1]),
        "search_translation_m": max(default.search_translation_m, factor * how[2]),
    }


def calibrate_once(run: Run, day: Day) -> dict[str, Any]:
    """Calibrate a day as a run says and measure every pair against truth."""
    if not day.rows:
        return {"refused": "ingest refused the day", "pairs": {}}
    camera = day.fleet.rig_of(next(iter(day.fleet.vehicles))).camera.known
    prior = replace(prior_of(day, run.prior, run.seed), camera=camera)
    fleet = day.fleet.changed(solve=search_range(run.prior) | run.solve)
    about = Inputs(Partition(VEHICLE, DATE), run.method, "study", run.seed, ())
    began = time.process_time()
    try:
        records = records_of_rows(day.rows, prior, fleet, about)
    except SolveError as err:
        return {"refused": err.reason, "pairs": {}}
    measured = {
        r.pair: measure(r, day.pointing_of(r.pair), prior, day.truth.get(f"dt_{r.pair}_s"))
        | mounting_error(r, day.true_of(r.pair))
        for r in records
    }
    out = {"cpu_s": round(time.process_time() - began, 1), "pairs": measured}
    found = {r.pair: T for r in records if (T := transform_of(r)) is not None}
    if set(found) == set(PAIRS):
        azimuth, elevation, range_m = loop_errors(found)
        out["loop"] = [round(float(v), 5) for v in (np.degrees(azimuth), np.degrees(elevation), range_m)]
    return out


def run_study(
    runs: Sequence[Run],
    args: argparse.Namespace,
    summary: Callable[[list[dict[str, Any]]], str],
    row_of: Callable[[Run], str],
) -> None:
    """Run what is missing, a line per run as it finishes; then print the summary and write it beside the lines.

    Args:
        runs: all runs of the study.
        args: root (the days' folder), out, workers, limit, accept_commits.
        summary: Markdown of the results of `runs`.
        row_of: name of the table's row that a run belongs to, kept as `row` in its line.
    """
    now = commit_now()
    done = _results_of(runs, args, now)
    todo = [r for r in runs if r.key not in done][: args.limit]
    about = {"commit": now, "date": time.strftime("%Y-%m-%d")}
    print(f"{len(runs)} runs, {len(todo)} to do", flush=True)
    with (
        ProcessPoolExecutor(
            args.workers, mp_context=get_context("spawn"), initializer=os.nice, initargs=(5,)
        ) as pool,
        args.out.open("a") as out,
    ):
        jobs = {pool.submit(_work, run, args.root): run for run in todo}
        for number, job in enumerate(as_completed(jobs), 1):
            run = jobs[job]
            if (err := job.exception()) is not None:
                # The others need not wait; this one is missing until it is run again.
                print(f"{number}/{len(todo)} FAILED {run.day.name}: {err!r}", flush=True)
                continue
            result = {**asdict(run), "row": row_of(run), **about, **job.result()}
            out.write(json.dumps(result) + "\n")
            out.flush()
            print(f"{number}/{len(todo)} {run.method} {run.day.name}: {_line(result)}", flush=True)
    results = list(_results_of(runs, args, now).values())
    if results:
        text = f"{_heading(results, len(runs), args.out.stem)}\n\n{summary(results)}\n"
        args.out.with_suffix(".md").write_text(text)
        print(text)


def _work(run: Run, root: Path) -> dict[str, Any]:
    day = generated_day(run.day, root)
    return day.made_by | calibrate_once(run, day)


def _results_of(runs: Sequence[Run], args: argparse.Namespace, now: str) -> dict[str, dict[str, Any]]:
    """Newest line of each run in `args.out` that this code made or a person accepts, by key."""
    if not args.out.exists():
        return {}
    known = [json.loads(line) for line in args.out.read_text().splitlines()]
    lines = {key_of(r): r for r in known if is_accepted(r["commit"], now, args.accept_commits)}
    return {key: lines[key] for key in (r.key for r in runs) if key in lines}


def _heading(results: Sequence[dict[str, Any]], asked: int, study: str) -> str:
    """How much was run, whether its seeds were seen before, by which commits and when."""

    def all_of(name: str) -> str:
        return ", ".join(sorted({r[name] for r in results}))

    names = {"calibrated": "commit", "perceived": "perceived_by", "simulated": "simulated_by"}
    commits = "; ".join(f"{what} by commit {all_of(name)}" for what, name in names.items())
    return f"{look(study, results)}\n\n{len(results)} of {asked} runs on {all_of('date')}; {commits}"


def _line(result: dict[str, Any]) -> str:
    if not result["pairs"]:
        return f"refused: {result['refused']}"
    return "; ".join(
        f"{pair} {p['az_deg']:.3f}/{p['el_deg']:.3f}/{p['range_m']:.3f} {p['status']}"
        if "az_deg" in p
        else f"{pair} {p['status']}"
        for pair, p in result["pairs"].items()
    )


def boresight(*words: object) -> tuple[float, float]:
    """Run the command; raises where it fails. CPU seconds with all that it started, and its own peak memory [MB].

    The memory is read while it runs: what the system reports of a process that ended is at least its parent's.
    """
    process = subprocess.Popen([sys.executable, "-m", "jobs.cli", *map(str, words)], stdout=sys.stderr)
    status, peak_kb = Path(f"/proc/{process.pid}/status"), 0
    while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
        known = dict(line.split(":", 1) for line in status.read_text().splitlines())
        peak_kb = max(peak_kb, int(known.get("VmHWM", "0 kB").split()[0]))
        time.sleep(0.1)
    code, used = os.waitstatus_to_exitcode(ended[1]), ended[2]
    if code not in (0, 3):
        raise RuntimeError(f"boresight {' '.join(map(str, words))}: exit code {code}")
    return used.ru_utime + used.ru_stime, peak_kb / 1e3

"""Nights that are killed at random moments, workers and whole nights, and what their tables hold in the end.

Small whole nights (the installed command, logs to pages) over a fleet of tiny logs. In each round a fresh lake is
worked on by nights that are disturbed: a random worker is killed, or the night itself, or the night with all of its
processes, or (on Ray) a node with all that runs on it, which another one follows, at random moments; SIGKILL each time.
Then one night is left alone, and its lake is held against one that was never disturbed: the same frames and
observations byte for byte, the same records and nothing twice, the same findings, states and pages, and no temporary
file. With `--storage s3` the lake is in a bucket, whose server meanwhile gives every twentieth request a fault: an
answer of 503 or 500, a late one, one later than the client waits, none at all though the request was carried out.

    python -m tests.benchmarks.studies.soak [--kills 200] [--seconds 220] [--executor process] [--storage folder]

`--executor ray` is a cluster of two nodes that outlives the nights, as `RAY_ADDRESS` names one; `ray-own` is what a
night without it starts for itself. A line per round is added to results/soak.jsonl until the executor and storage have
that many kills there; a run that `--seconds` ended goes on where it was. Any difference ends the run with exit code 1
and is in the round's line.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from pipeline.store.current import current_drift, current_states
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.captures import CAPTURES
from schemas.drift import DRIFT, DriftFinding
from schemas.features import FEATURES
from schemas.outcomes import OUTCOMES, OutcomeRow
from schemas.states import STATES, StateRow
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.victims import CROWDS, Crowd
from tests.makers.fleet_files import fleet_toml
from tests.makers.s3_server import BUCKET, S3, running
from tests.makers.written_logs import START_NS, Kit

RESULTS = Path("tests/benchmarks/results/soak.jsonl")
VEHICLES, DAYS, FRAMES = 3, 3, 5
DAY_NS = 86_400 * 10**9
KILLS_A_ROUND = 20
# A kill comes within this time of the last one: half of a night and more, on two busy cores.
SECONDS_TO_DRAW = {"process": 6.0, "ray": 10.0, "ray-own": 10.0}
# Every twentieth request; once in 820 one that takes longer than a client waits (`REQUEST_S` of `pipeline/store`).
FAULTS = {"mix": ["503", "500", "slow", "lost"] * 10 + ["stall"], "every": 20, "slow_s": 1.5, "stall_s": 32.0}


@dataclass
class Round:
    """What was done to one lake, and how it differed in the end."""

    worker_kills: int = 0
    night_kills: int = 0
    group_kills: int = 0
    node_kills: int = 0
    nights: int = 0
    requests: dict[str, int] = field(default_factory=dict)
    differences: list[str] = field(default_factory=list)

    @property
    def kills(self) -> int:
        return self.worker_kills + self.night_kills + self.group_kills + self.node_kills


@dataclass(frozen=True)
class Soak:
    """Where it happens: the fleet's logs, its temporary files, and the processes that nights consist of."""

    folder: Path
    crowd: Crowd
    seconds: float = SECONDS_TO_DRAW["process"]
    faults: dict[str, Any] = field(default_factory=lambda: FAULTS)
    until: float = float("inf")  # of the monotonic clock: a round that lasts longer is ended with fewer kills

    @property
    def scratch(self) -> Path:
        """Where processes put what they need for a while."""
        return self.folder / "tmp"

    def command(self, lake: str) -> list[str]:
        """A night over all logs."""
        logs = f"{self.folder}/logs/{{vehicle}}/{{day}}/*"
        night = ["nightly", "--fleet", f"{self.folder}/fleet.toml", "--lake", lake, "--logs", logs]
        return [f"{sys.prefix}/bin/boresight", *night, "--executor", self.crowd.executor, "--workers", "2"]

    def started(self, lake: str) -> subprocess.Popen[str]:
        """A night in a process group of its own."""
        self.scratch.mkdir(exist_ok=True)
        environment = os.environ | {"TMPDIR": str(self.scratch)}
        return subprocess.Popen(
            self.command(lake), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment,
            start_new_session=True,
        )  # fmt: skip

    def undisturbed(self, lake: str) -> dict[str, Any]:
        """A night that is left alone; its summary."""
        process = self.started(lake)
        out, _ = process.communicate(timeout=600)
        if process.returncode not in (0, 3):
            raise RuntimeError(f"an undisturbed night ended with {process.returncode}: {out[-2000:]}")
        told: dict[str, Any] = json.loads(out.splitlines()[-1])
        return told


def make_fleet(folder: Path, days: int = DAYS) -> None:
    """Tiny logs of a few vehicles and days, in three containers."""
    vehicles = [f"car-{v}" for v in range(VEHICLES)]
    for v, vehicle in enumerate(vehicles):
        for d in range(days):
            place = folder / "logs" / vehicle / f"2026-03-{2 + d:02d}"
            place.mkdir(parents=True)
            kit = Kit(ros=1 if v % 3 == 1 else 2, frames=FRAMES).drive(START_NS + d * DAY_NS + v * 10**9)
            (kit.mcap, kit.bag, kit.folder)[v % 3](place / ("a.mcap", "a.bag", "a")[v % 3])
    (folder / "fleet.toml").write_text(fleet_toml(*vehicles))


def disturbed(soak: Soak, lake: str, kills: int, rng: np.random.Generator) -> Round:
    """Nights on one lake, killed until there were so many kills; the last one that is killed leaves all as it is."""
    told = Round()
    while told.kills < kills and time.monotonic() < soak.until:
        process = soak.started(lake)
        told.nights += 1
        try:
            _disturb(soak, process, told, kills, rng)
        finally:
            soak.crowd.wait_until_gone(process)
    return told


def _disturb(
    soak: Soak, process: subprocess.Popen[str], told: Round, kills: int, rng: np.random.Generator
) -> None:
    """Kill until the night is gone, by itself or not."""
    crowd = soak.crowd
    while told.kills < kills and time.monotonic() < soak.until:
        try:
            process.communicate(timeout=float(rng.uniform(0.0, soak.seconds)))
        except subprocess.TimeoutExpired:
            workers = crowd.workers(process.pid)
            choice = rng.integers(4 if crowd.kill_node is None else 5)
            if choice < 2 and workers:
                with suppress(psutil.NoSuchProcess):
                    workers[rng.integers(len(workers))].kill()
                    told.worker_kills += 1
            elif choice == 2:
                process.kill()
                told.night_kills += 1
                return
            elif choice == 3:
                crowd.kill_all(process)
                told.group_kills += 1
                return
            elif choice == 4 and crowd.kill_node is not None:
                crowd.kill_node(int(rng.integers(2)))
                told.node_kills += 1
        else:
            return


def contents(lake: Lake) -> dict[str, Any]:
    """What a lake holds, without when it came there: by table and key."""
    found: dict[str, Any] = {}
    for table in (
        "moments",
        *(t.name for t in CAPTURES.values()),
        "perceived",
        *(t.name for t in FEATURES.values()),
    ):
        for path in lake.files.find(lake.root / table, "vehicle=*/day=*/*.parquet"):
            with lake.files.opened(path) as stream:
                found[f"{table} {path.relative_to(lake.root / table)}"] = hashlib.sha256(
                    stream.read()
                ).hexdigest()
    rows: list[tuple[str, Any]] = [
        ("calibrations", r) for r in read_records(lake, CALIBRATIONS, CalibrationRecord)
    ]
    done = [r for r in read_records(lake, OUTCOMES, OutcomeRow) if r.status != "failed"]
    rows += [("outcomes", replace(r, seconds=0.0, began_at="", bytes_read=0, bytes_written=0)) for r in done]
    # Audits of killed nights, which saw fewer days, stay in the table; the last one counts.
    rows += [("drift", r) for r in current_drift(read_records(lake, DRIFT, DriftFinding))]
    rows += [("states", r) for r in current_states(read_records(lake, STATES, StateRow))]
    about = {t.name: t.about for t in (CALIBRATIONS, OUTCOMES, DRIFT, STATES)}
    for table, row in rows:
        key = " ".join([table, *(getattr(row, name) for name in about[table]), row.work_key])
        twice = "" if key not in found else f" again {len(found)}"
        found[key + twice] = repr(astuple(replace(row, recorded_at="", asserted_at="")))
    report = lake.root / "report"
    for path in lake.files.find(report, "**/*"):
        if path.suffix in (".html", ".js"):
            # Pages of days name the audit that they were drawn after, which a killed night's may be. Commands of the
            # fleet's page name its own lake.
            with lake.files.opened(path) as stream:
                text = stream.read().replace(str(lake.root).encode(), b"LAKE")
                same = hashlib.sha256(text).hexdigest() if path.parent == report else ""
            found[f"page {path.relative_to(report)}"] = same
    return found


def differences(soak: Soak, lake: Lake, wanted: dict[str, Any]) -> list[str]:
    """How a lake differs from one that was never disturbed, and what was left lying about."""
    found = contents(lake)
    told = [f"lost: {key}" for key in sorted(set(wanted) - set(found))]
    told += [f"too much: {key}" for key in sorted(set(found) - set(wanted))]
    told += [f"differs: {key}" for key in sorted(wanted) if key in found and found[key] != wanted[key]]
    told += [f"unreadable: {damage}" for damage in lake.damage]
    told += [f"left over: {path}" for path in lake.files.find(lake.root, "**/*") if ".writing-" in path.name]
    told += [f"left over: {path}" for path in soak.scratch.rglob("*") if path.is_file()]
    return told


def soak_round(
    soak: Soak, lake: str, kills: int, rng: np.random.Generator, wanted: dict[str, Any], s3: S3 | None = None
) -> Round:
    """Disturb a lake, let one night finish it, and compare; its bucket is at fault until then."""
    before = {} if s3 is None else s3.faults(**soak.faults)
    told = disturbed(soak, lake, kills, rng)
    summary = soak.undisturbed(lake)
    if s3 is not None:
        after = s3.faults(mix=[])
        told.requests = {k: after[k] - before[k] for k in ("requests", "failed", "slowed", "stalled", "lost")}
    told.differences = differences(soak, Lake.at(lake), wanted)
    if summary["failed"]:
        told.differences.append(f"failed in a night that was left alone: {summary['problems']}")
    return told


@contextmanager
def storage(kind: str) -> Iterator[S3 | None]:
    """A bucket of its own where the lake shall be in one; the environment says where it is."""
    with running() if kind == "s3" else nullcontext(None) as s3:
        if s3 is not None:
            os.environ.update(s3.environment)
        yield s3


def main() -> int:
    """Soak until there are as many kills as asked for, or the time ends."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--executor", choices=CROWDS, default="process")
    parser.add_argument("--storage", choices=("folder", "s3"), default="folder")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    until, code = time.monotonic() + given.seconds, 0
    how = {"executor": given.executor, "storage": given.storage, "seed": given.seed}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        s3 = stack.enter_context(storage(given.storage))
        crowd = stack.enter_context(CROWDS[given.executor](folder / "tmp"))
        soak = Soak(folder, crowd, SECONDS_TO_DRAW[given.executor], until=until)
        make_fleet(soak.folder)
        lakes = str(soak.folder) if s3 is None else f"s3://{BUCKET}"
        soak.undisturbed(f"{lakes}/quiet")
        wanted = contents(Lake.at(f"{lakes}/quiet"))
        while time.monotonic() < until:
            before = [line for line in _lines() if all(line[k] == v for k, v in how.items())]
            if sum(line["kills"] for line in before) >= given.kills:
                break
            rng = np.random.default_rng([given.seed, len(before)])
            lake = f"{lakes}/lake-{len(before)}"
            told = soak_round(soak, lake, KILLS_A_ROUND, rng, wanted, s3)
            line = {"commit": commit_now(), **how, "round": len(before), "kills": told.kills, **vars(told)}
            sys.stdout.write(json.dumps(line) + "\n")
            with RESULTS.open("a") as file:
                file.write(json.dumps(line) + "\n")
            code = code or int(bool(told.differences))
    return code


def _lines() -> list[dict[str, Any]]:
    return [json.loads(line) for line in RESULTS.read_text().splitlines()] if RESULTS.exists() else []


if __name__ == "__main__":
    sys.exit(main())

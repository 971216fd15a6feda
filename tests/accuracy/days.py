"""The fixed days of the accuracy gate, made from logs or the simulator each time, and what `joint` finds on them.

The days are for tuning: nothing that they show is a claim about others.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.rig.day_prior import read_prior
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import Day, DaySpec
from tests.benchmarks.studies.engine import Run, calibrate_once
from tests.makers.simulated_days import perceived, simulated_day

__all__ = ["FIXED", "WHOLE", "FixedDay", "Made", "make_day", "measure_day"]

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
_HERE = Path(__file__).parent
_LEFT_OUT = 10  # a draw but the first leaves out one frame in so many


@dataclass(frozen=True)
class FixedDay:
    """A day of the gate.

    Args:
        name: in the baseline.
        spec: of the simulator; for other days only what the study's engine wants to print.
        prior: how the start differs from the truth (see `engine.Run`).
        logs: pattern of logs under the shared data; empty for a simulated day.
        fleet: configuration of these logs.
        partition: vehicle and day of these logs.
        held: pairs that are not accepted today though nothing is wrong with the day; a comment says why.
    """

    name: str
    spec: DaySpec
    prior: tuple[str, float, float] = ("exact", 2.0, 0.1)
    logs: str = ""
    fleet: Path = Path()
    partition: Partition | None = None
    held: tuple[str, ...] = ()


FIXED = (
    FixedDay("demo", DaySpec(171, "urban", 32, "demo")),
    FixedDay("paper, town", DaySpec(174, "urban", 40, "paper")),
    # Near and far edges lie apart: azimuth is known to 0.08 deg and errs by 0.06.
    FixedDay("paper, highway", DaySpec(172, "highway", 40, "paper"), held=("camera_lidar",)),
    # Camera-lidar of 16 rings is known to 0.09 deg, which 0.2 deg at 99.5 % does not allow.
    FixedDay("ring16", DaySpec(173, "mixed", 40, "ring16"), held=("camera_lidar", "camera_radar")),
    # A world that a seed drew (a parking deck) and that no tuning saw; its elevation errs by two of its sigmas.
    FixedDay("drawn world", DaySpec(6390, "world-6390", 40, "demo"), held=("camera_lidar",)),
    FixedDay(
        "real car", DaySpec(0, "real", 0, "real"), logs="astyx/astyx-1_*",
        fleet=_HERE.parent / "end_to_end" / "astyx.toml", partition=Partition("astyx-1", "2019-01-14"),
    ),
    FixedDay(
        "other world", DaySpec(0, "other", 0, "other_world"), prior=("logged", 5.0, 0.1),
        logs="other_world/*.mcap", fleet=_HERE / "other_world.toml", partition=Partition("veh00", "2026-03-02"),
    ),
)  # fmt: skip


# Days whose pairs are all found and that tuning may look at.
WHOLE = tuple(fixed.name for fixed in FIXED if fixed.name not in {"other world", "drawn world"})


@dataclass(frozen=True, eq=False)
class Made:
    """A day from logs to observations, and the CPU seconds that ingest and perceive took."""

    fixed: FixedDay
    day: Day
    cpu_s: float


def make_day(fixed: FixedDay, folder: Path) -> Made | None:
    """The day perceived anew in a folder; None where its recordings are not on this machine."""
    began = time.process_time()
    if not fixed.logs:
        spec = fixed.spec
        made = simulated_day(
            folder, frames=spec.frames, environment=spec.environment, rig=spec.rig, seed=spec.seed
        )
        return Made(fixed, Day(spec, made.observations, made.told, made.fleet, {}), _since(began))
    logs = sorted(SHARED.glob(fixed.logs))
    if not logs:
        return None
    assert fixed.partition is not None, fixed.name
    made = perceived(fixed.fleet, Lake.at(folder / "lake"), fixed.partition, logs, folder)
    rows = made.observations
    return Made(fixed, Day(fixed.spec, rows, _truth(fixed, made), made.fleet, {}), _since(began))


def _truth(fixed: FixedDay, made: Any) -> dict[str, object]:
    """The truth beside the logs; of the real car what its logs say, which is good to about .2 deg."""
    beside = SHARED / Path(fixed.logs).parent / "truth.json"
    if beside.exists():
        known = json.loads(beside.read_text())
        known["T_camera_radar"] = np.array(known["T_camera_lidar"]) @ np.array(known["T_lidar_radar"])
        return known
    given = read_prior(made.observations, made.fleet, made.partition.vehicle)
    return {f"T_{pair}": given.of(pair) for pair in PAIRS}


def measure_day(made: Made, draw: int = 0) -> dict[str, Any]:
    """Calibrate a day and measure it: errors [deg, m], verdicts, sigmas held or not, CPU seconds.

    Draw 0 has all frames; another leaves out a tenth of them.
    """
    rows = [row for i, row in enumerate(made.day.rows) if not draw or i % _LEFT_OUT != draw]
    run = Run(made.day.spec, prior=made.fixed.prior, seed=draw)
    return calibrate_once(run, replace(made.day, rows=rows))


def _since(began: float) -> float:
    return time.process_time() - began

"""A small simulated vehicle-day, perceived: what several rooms need when real rows matter; with its truth."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core.config import FleetConfig, load_fleet
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.calibrations import PAIRS
from schemas.observations import Observation
from tests.makers.kept_days import kept_fleet
from tests.makers.stages import ingest_day, perceive_day

DATE = "2026-03-02"


@dataclass(frozen=True, eq=False)
class SimulatedDay:
    """Where the day's tables are, its observations, and its true transforms by pair."""

    lake: Lake
    partition: Partition
    fleet: FleetConfig
    fleet_file: Path
    observations: list[Observation]
    truth: dict[str, np.ndarray]
    told: dict[str, float]  # all that the simulator's truth file says


def simulated_day(
    folder: Path,
    *,
    frames: int,
    environment: str = "urban",
    rig: str = "demo",
    seed: int = 21,
    faults: str = "",
) -> SimulatedDay:
    """Simulate, ingest and perceive one day into a folder: about 0.3 CPU seconds a frame for the demo rig."""
    kept_fleet(
        FleetSpec(
            vehicles=1,
            days=1,
            first_day=DATE,
            frames=frames,
            rig=rig,
            environments=environment,
            seed=seed,
            faults=parse_faults(faults, [DATE]),
        ),
        folder,
    )
    fleet, lake, partition = folder / "fleet.toml", Lake.at(folder / "lake"), Partition("vehicle-1", DATE)
    return perceived(fleet, lake, partition, sorted((folder / "logs" / "vehicle-1" / DATE).iterdir()), folder)


def perceived(
    fleet_file: Path, lake: Lake, partition: Partition, logs: list[Path], folder: Path
) -> SimulatedDay:
    """Ingest and perceive logs; the truth is read where the folder has one."""
    config = load_fleet(fleet_file)
    ingest_day(logs, partition, config, lake)
    perceive_day(partition, config, lake)
    path = folder / "truth" / partition.vehicle / f"{partition.day}.json"
    told = json.loads(path.read_text()) if path.exists() else {}
    rows = list(observations_of(lake, partition))
    return SimulatedDay(lake, partition, config, fleet_file, rows, transforms_of(told), told)


def transforms_of(told: dict[str, float]) -> dict[str, np.ndarray]:
    """Transforms by pair of a truth file's content."""
    return {p: np.array(told[f"T_{p}"]) for p in PAIRS if f"T_{p}" in told}

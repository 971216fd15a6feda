"""A small simulated vehicle-day, perceived: what several rooms need when real rows matter; with its truth."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.config import FleetConfig, load_fleet
from pipeline.core.results import Outcome
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.calibrations import PAIRS
from schemas.observations import Observation
from tests.makers.kept_days import kept_fleet
from tests.makers.stages import ingest_day, perceive_day

DATE = "2026-03-02"


@dataclass(frozen=True, eq=False)
class SimulatedDay:
    """Where the day's tables are, what ingest and perceive came to, and its truth."""

    lake: Lake
    partition: Partition
    fleet: FleetConfig
    fleet_file: Path
    outcomes: tuple[Outcome, Outcome]
    told: dict[str, Any]  # all that the simulator's truth file says

    @cached_property
    def observations(self) -> list[Observation]:
        """Of a rig with one sensor of each kind."""
        return list(observations_of(self.lake, self.partition))

    @property
    def truth(self) -> dict[str, np.ndarray]:
        """True transforms by pair, of such a rig."""
        return transforms_of(self.told)


def simulated_day(
    folder: Path, *, environment: str = "urban", rig: str = "demo", seed: int = 21, faults: str = "",
    **spec: int,
) -> SimulatedDay:  # fmt: skip
    """Simulate, ingest and perceive one day into a folder: about 0.3 CPU seconds a frame for the demo rig."""
    named = parse_faults(faults, [DATE], rig_named(rig))
    about = {"rig": rig, "environments": environment, "seed": seed, "faults": named}
    kept_fleet(FleetSpec(vehicles=1, days=1, first_day=DATE, **about, **spec), folder)
    fleet, lake, partition = folder / "fleet.toml", Lake.at(folder / "lake"), Partition("vehicle-1", DATE)
    return perceived(fleet, lake, partition, sorted((folder / "logs" / "vehicle-1" / DATE).iterdir()), folder)


def perceived(
    fleet_file: Path, lake: Lake, partition: Partition, logs: list[Path], folder: Path
) -> SimulatedDay:
    """Ingest and perceive logs; the truth is read where the folder has one."""
    config = load_fleet(fleet_file)
    outcomes = ingest_day(logs, partition, config, lake), perceive_day(partition, config, lake)
    path = folder / "truth" / partition.vehicle / f"{partition.day}.json"
    told = json.loads(path.read_text()) if path.exists() else {}
    return SimulatedDay(lake, partition, config, fleet_file, outcomes, told)


def transforms_of(told: dict[str, Any]) -> dict[str, np.ndarray]:
    """Transforms by pair of a truth file's content."""
    return {p: np.array(told[f"T_{p}"]) for p in PAIRS if f"T_{p}" in told}

"""Vehicle-days with images for the studies of networks, and the networks that they judge.

Test days are those of Table 1 (`ssl_fleet.py --parts table1`). Tuning days are those vehicles of the training fleet
that no network learned from: the sides val and test of table training.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx

from pipeline.calibrate.records import environment_of
from pipeline.config import FleetConfig, load_fleet
from pipeline.extrinsics.estimates import Prior
from pipeline.extrinsics.prior import perturbed
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of, observations_of
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from schemas.observations import Observation
from tests.benchmarks.studies.days import DATE, SETS, VEHICLE, DaySpec
from tests.benchmarks.studies.engine import ROTATION_SIGMA_DEG, TRANSLATION_SIGMA_M

__all__ = ["ModelSet", "SslDay", "Where", "fleet_days", "open_day", "simulated_days", "table1_days"]


@dataclass(frozen=True)
class Where:
    """A vehicle-day on the disk: a folder with fleet.toml, lake and truth."""

    folder: Path
    vehicle: str
    day: str
    seed: int

    @property
    def name(self) -> str:
        """What result lines call it."""
        return self.folder.name if self.vehicle == VEHICLE and self.day == DATE else self.vehicle


@dataclass(frozen=True, eq=False)
class SslDay:
    """A day, opened; frames are read when they are asked for."""

    where: Where
    rows: list[Observation]
    truth: dict[str, object]
    fleet: FleetConfig

    @property
    def fleet_file(self) -> Path:
        """What paths are relative to."""
        return self.where.folder / "fleet.toml"

    @property
    def lake(self) -> Lake:
        """Tables."""
        return Lake.at(self.where.folder / "lake")

    @property
    def partition(self) -> Partition:
        """Vehicle and day."""
        return Partition(self.where.vehicle, self.where.day)

    @property
    def environment(self) -> str:
        """Urban, highway or mixed, from the speeds."""
        return environment_of(self.rows)

    def true_of(self, pair: str) -> np.ndarray:
        """True transform of a pair."""
        return np.array(self.truth[f"T_{pair}"], np.float64)

    def prior(self, rotation_deg: float, translation_m: float, seed: int) -> Prior:
        """The truth moved by exactly so much, as `engine.prior_of` does it for the other methods."""
        stated = float(np.radians(ROTATION_SIGMA_DEG)), TRANSLATION_SIGMA_M
        true = Prior(self.true_of("camera_lidar"), self.true_of("lidar_radar"), *stated)
        return perturbed(true, (rotation_deg, translation_m), seed)

    def spread(self, count: int) -> tuple[list[Observation], list[Frame]]:
        """At most so many frames, spread evenly over the day."""
        chosen = np.linspace(0, len(self.rows) - 1, min(count, len(self.rows))).round().astype(int)
        rows = [self.rows[i] for i in np.unique(chosen)]
        wanted = [o.frame_index for o in rows]
        return rows, list(frames_of(self.lake, self.partition, wanted))


def open_day(where: Where) -> SslDay:
    """Observations, truth and configuration."""
    rows = list(observations_of(Lake.at(where.folder / "lake"), Partition(where.vehicle, where.day)))
    truth = json.loads((where.folder / "truth" / where.vehicle / f"{where.day}.json").read_text())
    return SslDay(where, rows, truth, load_fleet(where.folder / "fleet.toml"))


def simulated_days(root: Path, specs: Sequence[DaySpec]) -> list[Where]:
    """Days of `days.generate_day` whose images were kept."""
    return [Where(root / spec.name, VEHICLE, DATE, spec.seed) for spec in specs]


def table1_days(root: Path) -> list[Where]:
    """The test days, in the order of table1.py, urban and highway by turns."""
    urban, highway = SETS["table1"][:5], SETS["table1"][5:]
    return simulated_days(root, [spec for both in zip(urban, highway, strict=True) for spec in both])


def fleet_days(root: Path) -> list[Where]:
    """The vehicles of a training fleet that judge networks, never those that teach them."""
    manifest = json.loads((root / "lake" / "training" / "manifest.json").read_text())
    vehicles = sorted({*manifest["vehicles"]["test"], *manifest["vehicles"]["val"]})
    return [
        Where(root, vehicle, truth.stem, 1000 + int(vehicle.split("-")[1]))
        for vehicle in vehicles
        for truth in sorted((root / "truth" / vehicle).glob("*.json"))
    ]


@dataclass(frozen=True)
class ModelSet:
    """One joint network, or three pairwise ones, under the name that tables call it."""

    name: str
    files: tuple[Path, ...]

    @classmethod
    def parse(cls, text: str) -> ModelSet:
        """`NAME=FILE` or `NAME=CAMERA_LIDAR,CAMERA_RADAR,LIDAR_RADAR`."""
        name, _, files = text.partition("=")
        found = cls(name, tuple(Path(f).resolve() for f in files.split(",") if f))
        if len(found.files) not in {1, len(PAIRS)} or not name:
            raise SystemExit(f"{text!r} is neither NAME=FILE nor NAME=FILE,FILE,FILE")
        return found

    @property
    def method(self) -> str:
        """The product's method that runs it."""
        return "joint-ssl" if len(self.files) == 1 else "pairwise-ssl"

    @property
    def row(self) -> str:
        """Its row of Table 1."""
        return self.method if self.method == "pairwise-ssl" else f"joint-ssl ({self.name})"

    @property
    def by_name(self) -> dict[str, Path]:
        """Files by what they estimate."""
        names = ("joint",) if self.method == "joint-ssl" else PAIRS
        return dict(zip(names, self.files, strict=True))

    @property
    def key(self) -> str:
        """Hash of what is computed with: a network that was trained on is another one, another card says nothing new.

        But for its `bias_sigma`, which decides how far answers are believed.
        """
        digest = hashlib.sha256()
        for _, path in sorted(self.by_name.items()):
            model = onnx.load(path)
            digest.update(model.graph.SerializeToString(deterministic=True))
            card = next((json.loads(p.value) for p in model.metadata_props if p.key == "card"), {})
            if "bias_sigma" in card:
                digest.update(json.dumps(card["bias_sigma"], sort_keys=True).encode())
        return digest.hexdigest()[:16]

    def configured(self, fleet: FleetConfig, iterations: int = 3) -> FleetConfig:
        """A configuration that names these files."""
        if self.method == "joint-ssl":
            files: dict[str, object] = {"model": str(self.files[0])}
        else:
            files = {"pairwise_models": {p: str(f) for p, f in self.by_name.items()}}
        return fleet.changed(learn={"iterations": iterations} | files)

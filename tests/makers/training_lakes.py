"""Lakes of a small fleet for the tests of prepare, loader and what trains on them: no simulator, seconds to make."""

from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np

from pipeline.core.config import FleetConfig
from pipeline.learn.prepare.sides import decided_sides
from pipeline.learn.prepare.survey import plan_days, survey_day
from pipeline.learn.sample.frame_sample import About, Reference, make_row
from pipeline.rig.estimates import Prior
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import perceived_days
from schemas.frames import Frame
from schemas.observations import Observation
from schemas.training import TrainingRow
from tests.makers import solve_scenes
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.lakes import write_frames, write_observations
from tests.makers.stages import prepare_day

SMALL = {
    "lidar_points": 1024, "edge_points": 128,
    "grid": {"width_deg": 51.2, "height_deg": 25.6},
}  # fmt: skip
WIDE = {"width_deg": 102.4, "height_deg": 57.6}  # a grid that holds the networks' own, turned by 4 deg
_OF_POINTS = ("lidar_points", "edge_points", "max_frames", "min_step_m", "seed")
PALETTE = np.random.default_rng(7).integers(0, 255, (256, 3)).astype(np.uint8)


def fleet_of(vehicles, grid=None, **prepare) -> FleetConfig:
    """A configuration that knows these vehicles, with small rows; keys of [prepare] and of [prepare.split]."""
    points = {name: value for name, value in prepare.items() if name in _OF_POINTS}
    split = {name: value for name, value in prepare.items() if name not in points}
    return FleetConfig.model_validate(
        {
            "fleet": {"name": "tests"},
            "rigs": {"default": THREE_SENSORS},
            "vehicles": {v: {"rig": "default"} for v in vehicles},
            "prepare": SMALL | points | {"split": split, "grid": SMALL["grid"] | (grid or {})},
        }
    )


def fill(lake: Lake, vehicle: str, day: str, frames: int = 6, seed: int | None = None, **changes) -> None:
    """Write frames and observations of one vehicle-day; each (vehicle, day) has scenes of its own."""
    if seed is None:
        seed = int.from_bytes(f"{vehicle}{day}".encode(), "big") % 2**31
    observations = solve_scenes.make_day(frames, seed=seed)
    rows = [frame_of(o, np.random.default_rng([seed, i]), **changes) for i, o in enumerate(observations)]
    partition = Partition(vehicle, day)
    write_frames(lake, partition, rows, f"frames-{seed}-{frames}")
    write_observations(lake, partition, observations, f"observations-{seed}-{frames}")


def prepare_all(lake, fleet):
    """What `boresight prepare` does, in this process; results by partition."""
    surveys = [survey_day(p, lake, fleet.prepare) for p in perceived_days(lake)]
    plan = plan_days(surveys, fleet.prepare, decided_sides(lake, fleet.prepare))
    return {s.partition: prepare_day(s.partition, fleet, lake, plan) for s in surveys}


def frame_of(observation: Observation, rng: np.random.Generator, **changes) -> Frame:
    """The frame that an observation could come from: its label image painted, its map as the sweep."""
    labels = cv2.imdecode(np.frombuffer(observation.labels_png, np.uint8), cv2.IMREAD_GRAYSCALE)
    size = (observation.image_width_px, observation.image_height_px)
    texture = cv2.resize(rng.integers(0, 120, (12, 16, 3)).astype(np.uint8), size)
    image = cv2.resize(PALETTE[labels], size, interpolation=cv2.INTER_NEAREST) // 2 + texture
    cloud, radar = observation.lidar_map_xyz_m, observation.radar_xyz_m
    values = dict.fromkeys((f.name for f in fields(Frame)), None)
    values |= {f.name: getattr(observation, f.name) for f in fields(Observation) if f.name in values}
    values |= {
        "lidar_stamp_ns": observation.stamp_ns, "labels_png": None,
        "image": cv2.imencode(".jpg", image)[1].tobytes(), "image_format": "jpeg",
        "lidar_x_m": cloud[:, 0], "lidar_y_m": cloud[:, 1], "lidar_z_m": cloud[:, 2],
        "lidar_intensity": rng.uniform(0, 90, len(cloud)).astype(np.float32), "lidar_deskewed": False,
        "radar_x_m": radar[:, 0], "radar_y_m": radar[:, 1], "radar_z_m": radar[:, 2],
        "radar_range_rate_mps": np.zeros(len(radar), np.float32),
    }  # fmt: skip
    return Frame(**(values | changes))


def sample_of(seed: int = 0, **prepare) -> TrainingRow:
    """A row of table training from a scene, by its true poses."""
    rng = np.random.default_rng(seed)
    observation = solve_scenes.make_observation(rng, seed, 0, float(seed))
    poses = Prior(solve_scenes.T_CAMERA_LIDAR, solve_scenes.T_LIDAR_RADAR, 0.02, 0.05)
    about = About("v", "2026-01-01", "default", "train", "p", "urban")
    config = fleet_of(["v"], **prepare).prepare
    return make_row(frame_of(observation, rng), observation, Reference(poses), about, config)


def fleet_lake(folder: Path, vehicles=("a", "b", "c", "d"), days=("2026-01-01",), frames: int = 6) -> Lake:
    """Vehicles that all drive on all of these days."""
    lake = Lake.at(folder)
    for vehicle in vehicles:
        for day in days:
            fill(lake, vehicle, day, frames)
    return lake

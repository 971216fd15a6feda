"""Study: how well could a perfectly trained network do? The matchers with true classes, nothing learned.

    python tests/benchmarks/ssl_oracle.py LAKE_FOLDER... [--frames 10] [--rotation 3] [--translation 0.1]

A LAKE_FOLDER holds fleet.toml, lake/ and truth/ as `boresight simulate`, `ingest` and `perceive` leave them. Points
take their classes from the image through the TRUE extrinsics, so the correlation alone is judged: its bias, its spread
in a single frame, and what refinement adds. Networks never see any of that.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from pipeline.config import PrepareConfig, load_fleet
from pipeline.extrinsics.prior import read_prior
from pipeline.geometry.se3 import exp_so3, from_rotation_translation
from pipeline.geometry.spherical import camera_direction_angles, to_spherical
from pipeline.geometry.targets import DEFAULT_TARGETS
from pipeline.learn.batches.collate import collate
from pipeline.learn.network.class_matcher import NEUTRAL, ClassMatcher
from pipeline.learn.network.inputs import NetworkInputs, crop, sensor_inputs
from pipeline.learn.network.occupancy_matcher import OccupancyMatcher
from pipeline.learn.network.outputs import pose_of_twist
from pipeline.learn.network.views import render
from pipeline.learn.sample.frame_sample import About, SampleRejectedError, make_row
from pipeline.learn.sample.grid import Grid
from pipeline.learn.train.semantics_loss import class_of_points
from pipeline.objective.differentiable.poses import transform_points
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of, observations_of
from schemas.training import UNKNOWN_CLASS


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--rotation", type=float, default=3.0, help="deg, uniform per axis")
    parser.add_argument("--translation", type=float, default=0.1, help="m, uniform per axis")
    parser.add_argument("--cell", type=float, default=0.4, help="deg")
    parser.add_argument("--iterations", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    grid = Grid(cell_deg=args.cell)
    for folder in args.folders:
        batch, truth = load(folder, args.frames, args.cell)
        T_cl, T_lr = (
            torch.tensor(truth[k], dtype=torch.float32).expand(len(batch), 4, 4)
            for k in ("T_camera_lidar", "T_lidar_radar")
        )
        print(folder.name, len(batch), "frames")
        for what, run, T_true in (
            ("camera_lidar", match_camera_lidar, T_cl),
            ("lidar_radar", match_lidar_radar, T_lr),
        ):
            for rotation, translation in ((0.0, 0.0), (args.rotation, args.translation)):
                start = disturb(T_true, rotation, translation)
                for number, T in enumerate([start, *run(batch, grid, start, T_cl, args.iterations)]):
                    print(
                        f"  {what:13s} +-{rotation:g} deg {translation:g} m  pass {number}: {summary(what, T, T_true)}"
                    )


def load(folder: Path, frames: int, cell_deg: float):
    """A batch of evenly spread frames, and the day's truth."""
    config = load_fleet(folder / "fleet.toml")
    truth_file = next((folder / "truth").glob("*/*.json"))
    vehicle, day = truth_file.parent.name, truth_file.stem
    lake, partition = Lake.at(str(folder / "lake")), Partition(vehicle, day)
    sensors = {f.frame_index: f for f in list(frames_of(lake, partition))}
    found = list(observations_of(lake, partition))
    prior = read_prior(found, config, vehicle)
    rows = []
    for n in np.linspace(0, len(found) - 1, frames).astype(int):
        about = About(vehicle, day, "paper", "train", "0", "unknown")
        try:
            rows.append(
                make_row(
                    sensors[found[n].frame_index],
                    found[n],
                    prior,
                    about,
                    PrepareConfig(grid_step_deg=cell_deg),
                )
            )
        except SampleRejectedError as err:
            print("rejected", err)
    return collate(rows), {
        k: np.array(v) for k, v in json.loads(truth_file.read_text()).items() if k.startswith("T_")
    }


def disturb(T: torch.Tensor, rotation_deg: float, translation_m: float) -> torch.Tensor:
    """Uniform rotations and shifts on the left, another one for each frame."""
    rng = np.random.default_rng(5)
    turn = exp_so3(np.radians(rng.uniform(-rotation_deg, rotation_deg, (len(T), 3))))
    shift = rng.uniform(-translation_m, translation_m, (len(T), 3))
    R_T = from_rotation_translation(turn, np.zeros((len(T), 3))) @ T.double().numpy()
    R_T[:, :3, 3] = T[:, :3, 3].numpy() + shift
    return torch.tensor(R_T, dtype=torch.float32)


@torch.no_grad()
def match_camera_lidar(batch, grid, T, T_true, iterations):
    """Passes of the class matcher with one-hot classes."""
    matcher = ClassMatcher(grid)
    sensors = sensor_inputs(batch, grid)
    grid_class = crop(batch.grid_class, batch.grid_step_deg, grid)
    known = grid_class != UNKNOWN_CLASS
    one_hot = torch.nn.functional.one_hot(torch.where(known, grid_class, 0).long(), 10).permute(0, 3, 1, 2)
    likelihood = torch.where(known[:, None], torch.log(one_hot * 0.9 + 0.01), torch.tensor(NEUTRAL))
    lidar_class = class_of_points(
        grid_class, transform_points(T_true, sensors.lidar_xyz_m), sensors.lidar_valid, grid
    )
    found = []
    for _ in range(iterations):
        inputs = NetworkInputs(sensors, T, T, T)
        view, _ = render(inputs, grid)
        rows = _rows_of(view.points_camera, transform_points(T, sensors.lidar_xyz_m))
        label = lidar_class.gather(1, rows)
        probability = torch.nn.functional.one_hot(torch.where(label == UNKNOWN_CLASS, 0, label), 10).float()
        weight = view.point_weight * (label != UNKNOWN_CLASS)
        match = matcher(likelihood, view.points_camera, probability, weight)
        T = pose_of_twist(match.twist) @ T
        found.append(T)
    return found


def _rows_of(picked: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Row numbers of picked points."""
    return torch.stack([torch.cdist(p, q).argmin(1) for p, q in zip(picked, points, strict=True)])


@torch.no_grad()
def match_lidar_radar(batch, grid, T, T_camera_lidar, iterations):
    """Passes of the occupancy matcher, which has no classes."""
    matcher = OccupancyMatcher(3)
    sensors = sensor_inputs(batch, grid)
    found = []
    for _ in range(iterations):
        view, _ = render(NetworkInputs(sensors, T_camera_lidar, T_camera_lidar @ T, T), grid)
        match = matcher(
            view.radar_lidar,
            view.radar_features,
            view.radar_valid,
            view.radar_has_elevation,
            view.objects,
            view.object_weight,
        )
        T = pose_of_twist(match.twist) @ T
        found.append(T)
    return found


def summary(pair: str, T: torch.Tensor, T_true: torch.Tensor) -> str:
    """Mean and median |error| and mean error of azimuth and elevation [deg], and of range [m], at the targets."""
    points = torch.tensor(DEFAULT_TARGETS, dtype=torch.float32)
    one, other = (transform_points(M, points).double().numpy() for M in (T, T_true))
    if pair == "lidar_radar":
        error = to_spherical(one) - to_spherical(other)
    else:
        error = camera_direction_angles(one) - camera_direction_angles(other)
        error = np.concatenate(
            [error, (np.linalg.norm(one, axis=-1) - np.linalg.norm(other, axis=-1))[..., None]], -1
        )
    error[..., :2] = np.degrees(error[..., :2])
    size = np.abs(error).mean(1)
    mean, median, bias = size.mean(0), np.median(size, 0), error.mean((0, 1))
    return (
        f"az/el/range mean {mean[0]:.3f}/{mean[1]:.3f}/{mean[2]:.3f} "
        f"median {median[0]:.3f}/{median[1]:.3f}/{median[2]:.3f} "
        f"bias {bias[0]:+.3f}/{bias[1]:+.3f}/{bias[2]:+.3f}"
    )


if __name__ == "__main__":
    main()

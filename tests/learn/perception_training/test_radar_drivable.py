"""The radar's drivable area learned from the lidar: labels by the prior, a network that beats geometry, resume, job."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch

from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError, ContractError
from pipeline.core.rows import take_rows
from pipeline.learn.perception_training.radar_drivable.network import build_drivable_network
from pipeline.learn.perception_training.radar_drivable.samples import (
    BLOCKED,
    FREE,
    UNKNOWN,
    day_samples,
    label_grid,
    samples_of_day,
)
from pipeline.learn.perception_training.radar_drivable.training import (
    DrivableTraining,
    area_iou,
    train_drivable,
)
from pipeline.learn.train.checkpoints import load_checkpoint
from pipeline.perceive.drivable import free_sector
from pipeline.rig.radar_grid import cell_centres, sector_mask, sector_of
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from pipeline.store.partitions import Lake, Partition
from tests.makers.fleet_files import fleet_toml
from tests.makers.lakes import write_observations
from tests.makers.solve_scenes import make_observation

PRIOR = np.eye(4)
QUICK = DrivableTraining(steps=40, batch_size=4, width=12, log_every=10)


def road(rng, **changes):
    """A road between two walls, ended by a third: the radar sees some of the walls and much clutter."""
    left, right, end = rng.uniform(3, 20), rng.uniform(3, 20), rng.uniform(12, 58)
    x, y = np.meshgrid(np.arange(0.5, 60), np.arange(-29.5, 30), indexing="ij")
    cells = np.stack([x, y, np.full_like(x, -1.5)], -1).reshape(-1, 3)
    free = (cells[:, 1] < left) & (cells[:, 1] > -right) & (cells[:, 0] < end)
    # Beyond the walls the lidar sees pavements and fronts, 8 m deep.
    seen = (cells[:, 0] < end + 8) & (cells[:, 1] < left + 8) & (cells[:, 1] > -right - 8)
    along = rng.uniform(2, end, 60)
    sides = np.where(np.arange(60) % 2, left, -right)
    across = rng.uniform(-right, left, 12)
    walls = np.concatenate([np.stack([along, sides], -1), np.stack([np.full(12, end), across], -1)])
    clutter = rng.uniform([3, -right], [end, left], (25, 2)).repeat(3, axis=0)  # manholes: three returns each
    xy = np.concatenate([walls, clutter]) + rng.normal(0, 0.15, (147, 2))
    power = np.append(rng.normal(10, 3, 72), rng.normal(-5, 3, 75)).astype(np.float32)  # manholes are weak
    points, static = np.column_stack([xy, np.zeros(147)]).astype(np.float32), np.zeros(147, np.uint8)
    sector = free_sector(points, static, True)
    values = {
        "radar_xyz_m": points, "radar_motion": static, "radar_power_db": power,
        "radar_residual_mps": np.zeros(147, np.float32), "radar_cluster": np.full(147, -1, np.int32),
        "lidar_drivable_xyz_m": cells[free].astype(np.float32), "lidar_map_xyz_m": cells[seen].astype(np.float32),
        "radar_drivable_azimuth_rad": sector.azimuth_rad, "radar_drivable_range_m": sector.range_m,
        "priors": {"lidar_radar": PRIOR}, "radar_velocity_mps": None, "ego_speed_mps": None,
    }  # fmt: skip
    return make_observation(rng, 0, 0, 0.0, **(values | changes))


def turn_left(angle_deg):
    """A radar that looks to the lidar's left."""
    return from_rotation_translation(exp_so3(np.array([0, 0, np.deg2rad(angle_deg)])), np.zeros(3))


def roads(count, seed):
    rng = np.random.default_rng(seed)
    return [road(rng) for _ in range(count)]


@pytest.fixture(scope="module")
def samples():
    """Roads to learn from, and others."""
    return day_samples(roads(48, 1), PRIOR, 99), day_samples(roads(16, 2), PRIOR, 99)


def test_labels_are_free_where_the_lidar_saw_road_blocked_where_it_saw_else_and_unknown_elsewhere():
    label = label_grid(roads(1, 3)[0], PRIOR)
    observation = roads(1, 3)[0]
    azimuth, ranges = cell_centres()
    x, y = ranges * np.cos(azimuth)[:, None], ranges * np.sin(azimuth)[:, None]

    def holds(points):
        return {(int(a), int(b)) for a, b in np.floor(points[:, :2])}

    free, seen = holds(observation.lidar_drivable_xyz_m), holds(observation.lidar_map_xyz_m)
    for a, r in np.ndindex(label.shape):
        cell = (int(np.floor(x[a, r])), int(np.floor(y[a, r])))
        assert label[a, r] == (FREE if cell in free else BLOCKED if cell in seen else UNKNOWN)
    assert set(np.unique(label)) == {FREE, BLOCKED, UNKNOWN}


def test_a_turn_of_the_prior_by_whole_directions_turns_the_labels_by_as_many():
    observation = roads(1, 4)[0]
    turned = turn_left(6.0)
    # The radar looks 6 deg to the left; a centre on the very edge of a lidar's cell may round either way.
    same = label_grid(observation, PRIOR)[3:] == label_grid(observation, turned)[:-3]
    assert same.mean() > 0.999
    assert np.mean(label_grid(observation, PRIOR) == label_grid(observation, turned)) < 0.99


@pytest.mark.slow
def test_the_network_beats_geometry_and_the_best_guess_on_roads_that_it_has_not_seen(samples, tmp_path):
    torch.set_num_threads(1)
    train, held_out = samples
    _, result = train_drivable(train, held_out, tmp_path, DrivableTraining(steps=160, batch_size=4, width=12))
    assert result.status == "done"
    assert result.report["network"] > result.report["geometric"] + 0.2
    assert result.report["network"] > result.report["constant"] + 0.2


def test_a_stopped_run_goes_on_to_the_same_weights(samples, tmp_path):
    torch.set_num_threads(1)
    train, held_out = samples
    train_drivable(train, held_out, tmp_path / "whole", QUICK)
    first = train_drivable(train, held_out, tmp_path / "parts", QUICK, time_limit_s=0.0)[1]
    assert (first.status, first.step) == ("time_limit", 0)

    def stop(step, *_):
        if step == 20:
            os.kill(os.getpid(), signal.SIGTERM)

    second = train_drivable(train, held_out, tmp_path / "parts", QUICK, progress=stop)[1]
    assert (second.status, second.signal, second.step) == ("stopped", signal.SIGTERM, 20)
    assert train_drivable(train, held_out, tmp_path / "parts", QUICK)[1].status == "done"
    one, two = (load_checkpoint(tmp_path / name / "last.pt")["network"] for name in ("whole", "parts"))
    assert all(torch.equal(one[name], two[name]) for name in one)
    steps = [json.loads(line) for line in (tmp_path / "parts" / "metrics.jsonl").read_text().splitlines()]
    assert [r["step"] for r in steps if "loss" in r] == [10, 20, 30, 40]


def test_a_run_goes_on_with_its_own_configuration_and_samples_only(samples, tmp_path):
    train, held_out = samples
    few = DrivableTraining(steps=1, batch_size=1, width=4)
    train_drivable(train, held_out, tmp_path, few)
    with pytest.raises(ConfigError, match="another folder"):
        train_drivable(train, held_out, tmp_path, DrivableTraining(steps=2, batch_size=1, width=4))
    with pytest.raises(ContractError, match="other samples"):
        train_drivable(held_out, train, tmp_path, few)
    with pytest.raises(ContractError, match="both are needed"):
        train_drivable(train, take_rows(train, np.arange(0)), tmp_path / "new", few)


def test_the_network_is_small_and_cells_without_label_do_not_count():
    assert sum(p.numel() for p in build_drivable_network(24, 0).parameters()) < 100_000
    label = np.full((1, 70, 60), UNKNOWN, np.uint8)
    label[0, :, :10] = FREE
    everything = np.ones(label.shape, bool)
    assert area_iou(everything, label) == 1
    label[0, :, 10:20] = BLOCKED  # areas: 50 of 200
    assert area_iou(everything, label) == pytest.approx(0.25)
    assert np.array_equal(sector_mask(*sector_of((label[0] == FREE).astype(float))), label[0] == FREE)


def test_the_job_labels_by_the_logged_prior_trains_and_leaves_model_manifest_and_card(tmp_path):
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(fleet_toml("a", "b"))
    turned = turn_left(4.0)
    lake, labels = Lake.at(tmp_path / "lake"), []
    for vehicle, prior in (("a", PRIOR), ("b", turned)):
        rng = np.random.default_rng(8)  # the same roads, told otherwise
        rows = [road(rng, priors={"lidar_radar": prior}) for _ in range(4)]
        write_observations(lake, Partition(vehicle, "2026-01-01"), rows, vehicle)
        found = samples_of_day(load_fleet(fleet), lake, Partition(vehicle, "2026-01-01"), 9)
        assert np.array_equal(found.label, np.stack([label_grid(o, prior) for o in rows]))
        labels.append(found.label)
    assert not np.array_equal(*labels)  # labels follow what is logged, right or wrong
    out = tmp_path / "run"
    command = [sys.executable, "-m", "jobs.cli", "train-radar-drivable", "--fleet", str(fleet), "--lake"]
    command += [str(tmp_path / "lake"), "--out", str(out), "--steps", "2", "--batch-size", "2"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert (summary["status"], summary["samples"], summary["held_out_samples"]) == ("done", 4, 4)
    card = json.loads((out / "radar_drivable.json").read_text())
    assert set(card["iou_held_out"]) == {"network", "geometric", "constant"}
    assert (out / "radar_drivable.toml").exists()
    assert (out / "radar_drivable.md").read_text().startswith("# Model card")

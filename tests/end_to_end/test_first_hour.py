"""The first hour with logs of one's own: `init`, then the night that it names, without an edit of what it wrote."""

import itertools
import json
import shlex
from pathlib import Path

import pytest
from torch.utils.data import DataLoader

from jobs.cli import main
from pipeline.learn.frames.torch_dataset import Frames
from pipeline.rig.topics import TOPICS
from pipeline.simulate.fleet import FleetSpec
from tests.conftest import SHARED
from tests.makers import data_sets
from tests.makers.commands import command
from tests.makers.copied_logs import copy_log
from tests.makers.kept_days import kept_fleet
from tests.makers.real_models import write_real_manifests

pytestmark = pytest.mark.slow
IMAGE = TOPICS["image"]


def beginning(log, folder, vehicle, day, pictures):
    """The first pictures of a recording and what was sent meanwhile, where a fleet keeps it."""
    images = itertools.count()

    def until(topic, _, data):
        if topic == IMAGE and next(images) == pictures:
            raise StopIteration
        return data

    return copy_log(log, folder / "logs" / vehicle / day / log.name, until)


def shared(name):
    path = SHARED / "data" / name
    if not path.exists():
        pytest.skip(f"{name} is not on this machine")
    return path


def said(capsys, *arguments, codes=(0,)):
    """What a command prints: its summary, or the list that `--json` asks for."""
    told = command(capsys, *arguments)
    assert told.code in codes, told.out
    return json.loads(told.out) if "--json" in arguments else told.summary


def simulated(folder):
    kept_fleet(FleetSpec(vehicles=1, days=1, frames=12, drives=1), folder / "made")
    return sorted((folder / "made" / "logs").glob("*/*/*"))


def no_lidar(folder):
    spec = FleetSpec(vehicles=1, days=1, frames=24, drives=1, rig="no_lidar", environments="urban", seed=3)
    kept_fleet(spec, folder / "made")
    return sorted((folder / "made" / "logs").glob("*/*/*"))


def real_car(folder):
    return [beginning(shared("astyx/astyx-1_2019-01-14_01.mcap"), folder, "astyx-1", "2019-01-14", 20)]


def other_world(folder):
    return [beginning(shared("other_world/veh00_20260302_0800.mcap"), folder, "veh00", "2026-03-02", 20)]


def nuscenes(folder):
    data = data_sets.nuscenes(folder / "data")
    call = ["convert", "nuscenes", str(data), "--out", str(folder / "made")]
    assert main(call) == 0
    return sorted((folder / "made" / "logs").glob("*/*/*"))


def kitti(folder):
    log = beginning(shared("kitti/kitti-1_2011-09-26_00.mcap"), folder, "kitti-1", "2011-09-26", 12)
    models = folder / "models"  # where `boresight models --fetch` puts its two, and what it calls them
    models.mkdir()
    write_real_manifests(models, shared("../models/espnetv2_city.onnx"), shared("../models/yolox_nano.onnx"))
    (models / "segmenter.toml").rename(models / "segformer-b0-ade20k.toml")
    (models / "detector.toml").rename(models / "yolox-nano.toml")
    return [log]


LOGS = {make.__name__: make for make in (simulated, no_lidar, real_car, other_world, nuscenes, kitti)}
THREE = {"camera_lidar", "camera_radar", "lidar_radar"}
PAIRS = {
    "simulated": THREE,
    "no_lidar": {"camera_radar", "camera_base", "radar_base"},
    "real_car": THREE,
    "other_world": THREE,
    # Its cameras have no labels, so their borders are steps of brightness; its radar sees no clusters.
    "nuscenes": {"camera_lidar", "lidar_base", "radar_base"},
    "kitti": {"camera_lidar"},  # it has no radar
}


@pytest.mark.parametrize("name", LOGS)
def test_logs_alone_lead_to_a_record(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    logs = LOGS[name](tmp_path)
    told = said(capsys, "init", *map(str, logs))
    if name == "kitti":  # one line: what `init` wrote as a comment
        fleet = Path("fleet.toml")
        fleet.write_text(fleet.read_text().replace("# semantics =", "semantics ="))
    command = shlex.split(told["next_steps"][-1])
    night = said(capsys, *command[1:], "--executor", "inline", codes=(0, 3))
    assert (night["vehicle_days"], night["failed"], night["refused"]) == (1, 0, 0), night
    records = said(capsys, "show", "calibrations", "--lake", "lake", "--json")
    computed = {r["pair"] for r in records if r["status"] in ("accepted", "held")}
    assert computed == PAIRS[name], {r["pair"]: (r["status"], r["reason"]) for r in records}
    if name == "no_lidar":
        state = said(capsys, "state", "--lake", "lake", "--json")
        assert {"base", "front", "left", "right", "corner_fl", "corner_fr"} <= {
            row["sensor"] for row in state
        }
        out = ["--out", "ros2", "--lake", "lake", "--vehicle", "vehicle-1"]
        assert said(capsys, "export", "ros2", *out, codes=(0, 3, 4))["outputs"]
        assert list(Path("lake/report").rglob("vehicle-1.html"))
    if name == "simulated":
        frames_reach_a_torch_loader(capsys)


def frames_reach_a_torch_loader(capsys):
    """With --force: camera-lidar of twelve frames is held, and the camera would be left out."""
    call = ["export", "frames", "--fleet", "fleet.toml", "--lake", "lake", "--out", "frames"]
    call += ["--format", "parquet", "--calibration", "day", "--force", "--unsplit"]
    card = said(capsys, *call, codes=(0, 3))
    frames = Frames("frames", "train")
    batch = next(iter(DataLoader(frames, batch_size=2, collate_fn=list)))
    assert len(frames) == card["frames"]["train"] > 2
    assert [set(frame["sensors"]) for frame in batch] == [{"camera", "lidar", "radar"}] * 2
    assert all(len(frame["sensors"]["lidar"]["points"]) > 1000 for frame in batch)

"""Lidar points told by the camera: labels, a network that learns them, its model in perception, resume, job."""

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from pipeline.core.errors import ConfigError, ContractError
from pipeline.core.rows import take_rows
from pipeline.learn.perception_training.lidar_semantics.labels import (
    KIND_OF_LABEL,
    KINDS,
    LABELS,
    UNLABELLED,
    hidden_points,
    project_labels,
    standing_points,
)
from pipeline.learn.perception_training.lidar_semantics.network import build_sweep_network, export_sweeps
from pipeline.learn.perception_training.lidar_semantics.samples import (
    SweepLayout,
    cut,
    day_images,
    layout_of,
    normal_of,
)
from pipeline.learn.perception_training.lidar_semantics.training import (
    SweepTraining,
    kind_scores,
    train_sweeps,
)
from pipeline.learn.train.checkpoints import load_checkpoint
from pipeline.perceive.ground import PointKind
from pipeline.perceive.models.range_image import POINT_LABEL_SETS, RangeImageSegmenter
from pipeline.rig.range_image import EMPTY
from pipeline.rig.se3 import transform_points
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from tests.makers.lakes import write_observations
from tests.makers.solve_scenes import CAMERA, LABEL_SCALE, T_CAMERA_LIDAR, make_observation
from tests.makers.training_lakes import fill, frame_of

LAYOUT = SweepLayout(24, 720, 8.0, -24.0)
ROAD, CAR = LABELS.index("road"), LABELS.index("car")
QUICK = SweepTraining(steps=6, batch_size=2, width=4, log_every=2)


def hits(origin, rays, wall_m, angle):
    """How far along each ray the scene is, and whether that is road (1.7 m below the lidar) rather than the wall."""
    to_road = np.where(rays[:, 2] < 0, (-1.7 - origin[2]) / np.minimum(rays[:, 2], -1e-6), np.inf)
    normal = np.array([np.cos(angle), np.sin(angle), 0])
    to_wall = (wall_m - origin @ normal) / np.maximum(rays @ normal, 1e-6)
    return np.minimum(to_road, to_wall), to_road < to_wall


def street(seed, count):
    """Frames with a road below and a wall of cars at random distance; labels as a camera without faults sees them."""
    camera, T_lidar_camera = CAMERA.scaled(LABEL_SCALE), np.linalg.inv(T_CAMERA_LIDAR)
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
    looks = camera.unproject(np.stack([u, v], -1).reshape(-1, 2).astype(float)) @ T_lidar_camera[:3, :3].T
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-28, 28, 0.5)), np.radians(np.arange(-17.8, 2.9, 0.8))
    )
    beams = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1
    ).reshape(-1, 3)
    made = []
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        wall_m, angle = rng.uniform(9, 25), rng.uniform(-0.2, 0.2)
        far, road = hits(np.zeros(3), beams, wall_m, angle)
        _, seen_road = hits(T_lidar_camera[:3, 3], looks, wall_m, angle)
        labels = np.where(seen_road, 0, 13).astype(np.uint8).reshape(v.shape)
        png = cv2.imencode(".png", labels)[1].tobytes()
        xyz = (beams * far[:, None]).astype(np.float32)
        observation = make_observation(rng, i, 0, float(i), labels_png=png, lidar_map_xyz_m=xyz)
        made.append((frame_of(observation, rng), observation, road))
    return made


def images_of(seed, count):
    made = street(seed, count)
    return day_images((f for f, _, _ in made), [o for _, o, _ in made], T_CAMERA_LIDAR, LAYOUT, 99)


@pytest.fixture(scope="module")
def samples():
    torch.set_num_threads(1)
    return cut(images_of(1, 24), images_of(2, 8))


def test_labels_are_those_that_perception_knows():
    known = POINT_LABEL_SETS["semantickitti"]
    assert tuple(known) == LABELS
    assert [PointKind(k) for k in KIND_OF_LABEL] == list(known.values())
    assert [PointKind(i).name.lower() for i in range(5)] == list(KINDS)


def test_points_take_their_pixels_class_and_none_near_boundaries_in_the_sky_or_behind_the_camera():
    _, observation, _ = street(3, 1)[0]
    image = np.full((observation.image_height_px // 2, observation.image_width_px // 2), 10, np.uint8)
    half, scale = image.shape[1] // 2, observation.image_height_px // 2
    image[scale // 2 :, :half], image[scale // 2 :, half:] = 0, 13
    changed = make_observation(
        np.random.default_rng(0),
        0,
        0,
        0.0,
        labels_png=cv2.imencode(".png", image)[1].tobytes(),
        label_scale=0.5,
    )
    pixels = np.array([[0.25, 0.8], [0.75, 0.8], [0.5, 0.8], [0.25, 0.2]]) * [
        CAMERA.width_px,
        CAMERA.height_px,
    ]
    rays = CAMERA.unproject(pixels) * 12.0
    inverse = np.linalg.inv(T_CAMERA_LIDAR)
    xyz = (rays @ inverse[:3, :3].T + inverse[:3, 3]).astype(np.float32)
    behind = -xyz[:1]
    found = project_labels(changed, T_CAMERA_LIDAR, np.concatenate([xyz, behind]))
    assert found.tolist() == [ROAD, CAR, UNLABELLED, UNLABELLED, UNLABELLED]


def test_what_stands_before_a_point_takes_its_label_and_the_road_takes_none():
    """A roof lidar sees past a van; the camera, lower down, sees the van there."""
    up, across = np.meshgrid(np.arange(-1.2, 0.9, 0.2), np.arange(-1.0, 1.01, 0.1))
    van = np.stack([np.full(up.size, 10.0), across.ravel(), up.ravel()], 1)
    wall = van * [2.5, 2.5, 1.0] + [0, 0, 0.3]
    aside = wall + [0, 12, 0]
    ahead = np.arange(5.0, 60.0, 0.5)
    road = np.stack([ahead, np.full(len(ahead), -9.0), np.full(len(ahead), -1.7)], 1)
    xyz = np.concatenate([van, wall, aside, road]).astype(np.float32)
    hidden = hidden_points(transform_points(T_CAMERA_LIDAR, xyz.astype(np.float64)), standing_points(xyz))
    of_van, of_wall, of_aside, of_road = np.split(hidden, np.cumsum([len(van), len(wall), len(aside)]))
    assert of_wall.mean() > 0.9
    assert not of_van.any()
    assert not of_aside.any()
    assert not of_road.any()


def test_layout_holds_the_sweeps_and_images_are_cut_to_where_labels_are(samples):
    layout = layout_of((f for f, _, _ in street(1, 3)), 24, 720)
    assert (layout.fov_up_deg, layout.fov_down_deg) == (3.0, -18.0)
    train, held_out = samples
    assert train.label.shape[2] == held_out.label.shape[2] < 200  # of 720: the camera sees a part
    assert train.label.shape[2] % 2 == 0
    assert np.all(train.label[train.channels[:, 0] == EMPTY] == UNLABELLED)
    assert set(np.unique(train.label)) == {UNLABELLED, ROAD, CAR}


@pytest.mark.slow
def test_the_network_learns_and_perception_gets_its_answers_from_the_exported_model(samples, tmp_path):
    train, held_out = samples
    config = SweepTraining(steps=120, batch_size=4, width=8)
    network, result = train_sweeps(train, held_out, tmp_path, config)
    assert result.status == "done"
    # Whoever calls everything by one name has half of it; seconds of training are not the end.
    assert result.report["iou_ground"] > 0.8
    assert result.report["iou_road_user"] > 0.8
    manifest = export_sweeps(network, LAYOUT, normal_of(train), tmp_path, {})
    segmenter = RangeImageSegmenter(manifest)
    for frame, _, road in street(4, 3):
        xyz = np.stack([frame.lidar_x_m, frame.lidar_y_m, frame.lidar_z_m], 1)
        turned = np.stack([-xyz[:, 1], xyz[:, 0], xyz[:, 2]], 1)  # to the left, where no camera looked
        for points in (xyz, turned):
            kinds = segmenter.kinds(points, frame.lidar_intensity)
            assert np.mean((kinds == PointKind.ROAD) == road) > 0.85
    assert "limits" in json.loads((tmp_path / "lidar_semantics.json").read_text())


def test_a_stopped_run_goes_on_to_the_same_weights_and_with_its_own_configuration_only(samples, tmp_path):
    train, held_out = samples
    train_sweeps(train, held_out, tmp_path / "whole", QUICK)
    stopped = train_sweeps(train, held_out, tmp_path / "parts", QUICK, time_limit_s=0.0)[1]
    assert (stopped.status, stopped.step) == ("time_limit", 0)
    calls = []

    def fail_at_four(step, *_):
        calls.append(step)
        if step == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_sweeps(train, held_out, tmp_path / "parts", QUICK, progress=fail_at_four)
    assert calls == [2, 4]
    assert train_sweeps(train, held_out, tmp_path / "parts", QUICK)[1].status == "done"
    one, two = (load_checkpoint(tmp_path / name / "last.pt")["network"] for name in ("whole", "parts"))
    assert all(torch.equal(one[name], two[name]) for name in one)
    with pytest.raises(ConfigError, match="another folder"):
        train_sweeps(train, held_out, tmp_path / "whole", SweepTraining(steps=7, width=4))
    with pytest.raises(ContractError, match="other samples"):
        train_sweeps(held_out, train, tmp_path / "whole", QUICK)
    with pytest.raises(ContractError, match="both are needed"):
        train_sweeps(train, take_rows(train, np.arange(0)), tmp_path / "new", QUICK)


def test_scores_are_those_of_the_definition():
    wanted = np.array([1, 1, 2, 3, 4, 4], np.uint8)
    found = np.array([1, 2, 2, 4, 4, 4], np.uint8)
    scores = kind_scores(found, wanted)
    assert scores == pytest.approx(
        {
            "accuracy": 4 / 6,
            "iou_ground": 1,
            "iou_road": 0.5,
            "iou_flat": 0.5,
            "iou_road_user": 0,
            "iou_other": 2 / 3,
        }
    )
    assert sum(p.numel() for p in build_sweep_network(16, 0).parameters()) < 100_000


@pytest.mark.slow
def test_the_job_trains_on_a_lake_holds_days_out_and_leaves_model_manifest_and_card(tmp_path):
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(
        '[fleet]\nname = "t"\n[rigs.default.camera]\nimage = "/i"\ninfo = "/c"\n'
        '[rigs.default.camera.semantics]\nsource = "topics"\nlabels = "/l"\ndetections = "/d"\n'
        '[rigs.default.lidar]\npoints = "/p"\n[rigs.default.radar]\npoints = "/r"\n'
        "[vehicles.a]\n[vehicles.b]\n"
    )
    lake = Lake.at(tmp_path / "lake")
    fill(lake, "a", "2026-01-01", 4)
    fill(lake, "b", "2026-01-02", 4)
    # Perception rejected a frame: it has no observation and teaches nothing.
    day = Partition("a", "2026-01-01")
    rows = list(observations_of(lake, day))
    write_observations(lake, day, rows[:1] + rows[2:], "again")
    out = tmp_path / "run"
    command = [sys.executable, "-m", "jobs.cli", "train-lidar-semantics", "--fleet", str(fleet), "--lake"]
    command += [
        str(tmp_path / "lake"),
        "--out",
        str(out),
        "--steps",
        "2",
        "--batch-size",
        "2",
        "--rows",
        "24",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert (summary["status"], summary["samples"], summary["held_out_samples"]) == ("done", 3, 4)
    assert summary["calibrated_days"] == 0
    assert RangeImageSegmenter(out / "lidar_semantics.toml").provenance["lidar_segmenter"]["input"][
        "size"
    ] == [24, 1024]
    assert (out / "lidar_semantics.md").read_text().startswith("# Model card")

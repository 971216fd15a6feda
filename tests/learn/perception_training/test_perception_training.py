"""Networks of perception taught by another sensor: labels, what each learns, resumed runs, the job, its model."""

import json
import os
import signal
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from jobs.cli import main
from pipeline.core.errors import ConfigError, ContractError
from pipeline.core.rows import take_rows
from pipeline.learn.perception_training import TASKS
from pipeline.learn.perception_training.lidar_semantics import (
    LABELS,
    UNLABELLED,
    SweepLayout,
    SweepTraining,
    cut,
    day_images,
    hidden_points,
    project_labels,
    standing_points,
)
from pipeline.learn.perception_training.radar_drivable import (
    BLOCKED,
    FREE,
    UNKNOWN,
    DrivableTraining,
    area_iou,
    day_samples,
    label_grid,
)
from pipeline.learn.perception_training.trainer import Samples, export_model, train_network
from pipeline.learn.train.loop import load_checkpoint
from pipeline.perceive.drivable import free_sector
from pipeline.perceive.ground import PointKind
from pipeline.perceive.models.radar_drivable import RadarDrivable
from pipeline.perceive.models.range_image import RangeImageSegmenter
from pipeline.rig.radar_grid import cell_centres, sector_mask, sector_of
from pipeline.rig.se3 import transform_points
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from tests.makers.fleet_files import fleet_toml
from tests.makers.lakes import write_observations
from tests.makers.solve_scenes import CAMERA, LABEL_SCALE, T_CAMERA_LIDAR, make_observation
from tests.makers.training_lakes import fill, frame_of

LAYOUT = SweepLayout(24, 720, 8.0, -24.0)
ROAD, CAR = LABELS.index("road"), LABELS.index("car")
PRIOR = np.eye(4)


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


def roads(count, seed):
    rng = np.random.default_rng(seed)
    return [road(rng) for _ in range(count)]


@pytest.fixture(scope="module")
def samples():
    torch.set_num_threads(1)
    scans = [day_samples(roads(count, seed), PRIOR, 99) for count, seed in ((48, 1), (16, 2))]
    sweeps = cut(Samples(images_of(1, 24), images_of(2, 8), {}))
    return {"lidar_semantics": sweeps, "radar_drivable": Samples(*scans, {})}


@pytest.fixture(params=TASKS)
def case(request, samples):
    """A task, its samples, and few steps of it."""
    task = TASKS[request.param]
    return task, samples[request.param], task.config(steps=6, batch_size=2, width=4, log_every=1)


def test_points_take_their_pixels_class_and_none_near_boundaries_in_the_sky_or_behind_the_camera():
    _, observation, _ = street(3, 1)[0]
    image = np.full((observation.image_height_px // 2, observation.image_width_px // 2), 10, np.uint8)
    half, scale = image.shape[1] // 2, observation.image_height_px // 2
    image[scale // 2 :, :half], image[scale // 2 :, half:] = 0, 13
    changed = replace(observation, labels_png=cv2.imencode(".png", image)[1].tobytes(), label_scale=0.5)
    places = np.array([[0.25, 0.8], [0.75, 0.8], [0.5, 0.8], [0.25, 0.2]])
    rays = CAMERA.unproject(places * [CAMERA.width_px, CAMERA.height_px]) * 12.0
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


@pytest.mark.slow
def test_the_network_learns_classes_and_perception_gets_them_from_the_exported_model(samples, tmp_path):
    task, sweeps = TASKS["lidar_semantics"], samples["lidar_semantics"]
    network, result = train_network(task, sweeps, tmp_path, SweepTraining(steps=120, width=8))
    assert result.status == "done"
    # Whoever calls everything by one name has half of it; seconds of training are not the end.
    assert result.report["iou_ground"] > 0.8
    assert result.report["iou_road_user"] > 0.8
    segmenter = RangeImageSegmenter(export_model(task, network, sweeps.train, tmp_path, {}))
    for frame, _, road in street(4, 3):
        xyz = np.stack([frame.lidar_x_m, frame.lidar_y_m, frame.lidar_z_m], 1)
        turned = np.stack([-xyz[:, 1], xyz[:, 0], xyz[:, 2]], 1)  # to the left, where no camera looked
        for points in (xyz, turned):
            kinds = segmenter.kinds(points, frame.lidar_intensity)
            assert np.mean((kinds == PointKind.ROAD) == road) > 0.85


@pytest.mark.slow
def test_the_network_beats_geometry_and_the_best_guess_on_roads_that_it_has_not_seen(samples, tmp_path):
    enough = DrivableTraining(steps=160, batch_size=4, width=12)
    _, result = train_network(TASKS["radar_drivable"], samples["radar_drivable"], tmp_path, enough)
    assert result.status == "done"
    assert result.report["iou_network"] > result.report["iou_geometric"] + 0.2
    assert result.report["iou_network"] > result.report["iou_constant"] + 0.2


def test_a_stopped_run_goes_on_to_the_same_weights(case, tmp_path):
    def run(folder, **options):
        task, samples, quick = case
        return train_network(task, samples, tmp_path / folder, quick, **options)[1]

    def stop(step, *_):
        if step == 4:
            os.kill(os.getpid(), signal.SIGTERM)

    run("whole")
    first = run("parts", time_limit_s=0.0)
    assert (first.status, first.step) == ("time_limit", 0)
    second = run("parts", progress=stop)
    assert (second.status, second.signal, second.step) == ("stopped", signal.SIGTERM, 4)
    assert run("parts").status == "done"
    one, two = (load_checkpoint(tmp_path / name / "last.pt")["network"] for name in ("whole", "parts"))
    assert all(torch.equal(one[name], two[name]) for name in one)
    steps = [json.loads(line) for line in (tmp_path / "parts" / "metrics.jsonl").read_text().splitlines()]
    assert [r["step"] for r in steps if "loss" in r] == [1, 2, 3, 4, 5, 6]


def test_a_run_goes_on_with_its_own_configuration_and_samples_only(case, tmp_path):
    task, samples, quick = case
    few = quick.model_copy(update={"steps": 1})
    train_network(task, samples, tmp_path, few)
    with pytest.raises(ConfigError, match="another steps"):
        train_network(task, samples, tmp_path, quick)
    with pytest.raises(ContractError, match="other samples"):
        swapped = replace(samples, train=samples.held_out, held_out=samples.train)
        train_network(task, swapped, tmp_path, few)
    for side in ("train", "held_out"):
        nobody = replace(samples, **{side: take_rows(samples.train, np.arange(0))})
        with pytest.raises(ContractError, match="add days with labels"):
            train_network(task, nobody, tmp_path / "new", few)


def test_cells_without_label_do_not_count():
    label = np.full((1, 70, 60), UNKNOWN, np.uint8)
    label[0, :, :10] = FREE
    everything = np.ones(label.shape, bool)
    assert area_iou(everything, label) == 1
    label[0, :, 10:20] = BLOCKED  # areas: 50 of 200
    assert area_iou(everything, label) == pytest.approx(0.25)
    assert np.array_equal(sector_mask(*sector_of((label[0] == FREE).astype(float))), label[0] == FREE)


def sweeps_lake(lake):
    for vehicle in ("a", "b"):
        fill(lake, vehicle, "2026-01-01", 4)
    # Perception rejected a frame: it has no observation and teaches nothing.
    day = Partition("a", "2026-01-01")
    rows = list(observations_of(lake, day))
    write_observations(lake, day, rows[:1] + rows[2:], "again")


def scans_lake(lake):
    rng = np.random.default_rng(8)
    for vehicle in ("a", "b"):
        rows = [road(rng, priors={"lidar_radar": PRIOR}) for _ in range(4)]
        write_observations(lake, Partition(vehicle, "2026-01-01"), rows, vehicle)


JOBS = {
    "lidar_semantics": (sweeps_lake, ["--rows", "24"], RangeImageSegmenter, (3, 4), {"iou_ground"}),
    "radar_drivable": (scans_lake, [], RadarDrivable, (4, 4), {"iou_network", "iou_geometric", "iou_constant"}),
}  # fmt: skip


@pytest.mark.parametrize("task", TASKS)
def test_the_job_trains_on_a_lake_holds_days_out_and_leaves_model_manifest_and_card(task, tmp_path, capsys):
    fill_lake, options, model, counts, scores = JOBS[task]
    (tmp_path / "fleet.toml").write_text(fleet_toml("a", "b"))
    fill_lake(Lake.at(tmp_path / "lake"))
    places = ["--fleet", str(tmp_path / "fleet.toml"), "--data", str(tmp_path / "lake")]
    command = ["train", "--task", task, *places, "--out", str(tmp_path / "run"), "--steps", "2", *options]
    assert main([*command, "--batch-size", "2"]) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (summary["status"], summary["samples"], summary["held_out_samples"]) == ("done", *counts)
    assert summary.get("calibrated_days", 0) == 0
    card = json.loads((tmp_path / "run" / f"{task}.json").read_text())
    assert card["training"]["batch_size"] == 2
    assert scores <= set(card["held_out"])
    assert tuple(card["limits"]) == TASKS[task].limits
    assert (tmp_path / "run" / f"{task}.md").read_text().startswith("# Model card")
    opened = model(tmp_path / "run" / f"{task}.toml")
    if task == "lidar_semantics":
        assert opened.provenance["lidar_segmenter"]["input"]["size"] == [24, 1024]


def test_an_option_of_the_other_task_is_refused_by_name(tmp_path, capsys):
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(fleet_toml("a"))
    command = ["train", "--data", str(tmp_path), "--out", str(tmp_path / "run")]
    perception = ["--task", "radar_drivable", "--fleet", str(fleet)]
    for options, named in (
        ([*perception, "--rows", "24"], "rows"),
        ([*perception, "--device", "cpu"], "device"),
        (perception[:2], "fleet"),
        (perception[2:], "fleet"),
        (["--columns", "24"], "columns"),
    ):
        assert main([*command, *options]) == 2
        assert named in json.loads(capsys.readouterr().out.splitlines()[-1])["reason"]

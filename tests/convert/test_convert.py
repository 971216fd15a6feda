"""Folders of the shape of public data sets become logs that `check` and `ingest` read, with the numbers they held."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from jobs.cli import main
from pipeline.convert.recording import ego_events
from pipeline.core.config import load_fleet
from pipeline.core.ros_messages import RosMessages
from pipeline.rig.se3 import exp_se3, from_quaternion
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of
from tests.makers import data_sets
from tests.makers.data_sets import (
    SPEED_MPS,
    T_BASE_CAMERA,
    T_BASE_LIDAR,
    T_BASE_RADAR,
    lidar_points,
    radar_points,
)

MAKERS = {"nuscenes": data_sets.nuscenes, "vod": data_sets.view_of_delft, "kitti": data_sets.kitti}
# Vehicle, day and how many frames there are.
WHAT = {
    "nuscenes": ("n008", "2018-08-01", 12),
    "vod": ("vod", "2021-05-04", 12),
    "kitti": ("kitti", "2021-05-04", 6),
}


def frames_in(folder, name, *options):
    """Logs that convert writes of a folder's data, and the frames that ingest makes of them."""
    call = ["convert", name, str(folder / "data"), "--out", str(folder), "--day", "2021-05-04"]
    assert main([*call, *options]) == 0
    vehicle, day, _ = WHAT[name]
    logs = sorted(map(str, (folder / "logs" / vehicle / day).iterdir()))
    about = ["--fleet", f"{folder}/fleet.toml", "--lake", f"{folder}/lake"]
    assert main(["ingest", *logs, *about, "--vehicle", vehicle, "--day", day]) == 0
    return logs, list(frames_of(Lake.at(folder / "lake"), Partition(vehicle, day)))


@pytest.fixture(scope="module", params=MAKERS)
def converted(request, tmp_path_factory):
    """Name, folder of what convert wrote, its logs, and the frames that ingest made of it."""
    name, folder = request.param, tmp_path_factory.mktemp(request.param)
    MAKERS[name](folder / "data")
    options = ["--camera", "CAM_FRONT"] if name == "nuscenes" else []
    return name, folder, *frames_in(folder, name, *options)


def test_every_frame_of_the_data_set_becomes_a_trio(converted):
    name, _, _, frames = converted
    assert len(frames) == WHAT[name][2]
    first = frames[0]
    assert (first.image_width_px, first.image_height_px) == (data_sets.WIDTH, data_sets.HEIGHT)
    np.testing.assert_array_equal(first.camera_K, data_sets.K)
    assert first.image_format == ("png" if name == "kitti" else "jpeg")


def test_a_folder_of_kitti_s_own_without_a_radar_becomes_a_rig_of_camera_and_lidar(tmp_path):
    data_sets.kitti(tmp_path / "data")
    shutil.rmtree(tmp_path / "data" / "radar")
    _, frames = frames_in(tmp_path, "kitti")
    assert load_fleet(tmp_path / "fleet.toml").rigs["default"].sensors == ("camera", "lidar")
    assert len(frames) == WHAT["kitti"][2]
    assert all(f.sensors == ["camera", "lidar"] and not len(f.radar_x_m) for f in frames)
    wanted = np.linalg.inv(T_BASE_CAMERA) @ T_BASE_LIDAR
    np.testing.assert_allclose(frames[0].priors["camera_lidar"], wanted, atol=1e-9)


def test_sensors_are_where_the_data_set_says(converted):
    _, _, _, frames = converted
    for pair, one, other in (
        ("camera_lidar", T_BASE_CAMERA, T_BASE_LIDAR),
        ("lidar_radar", T_BASE_LIDAR, T_BASE_RADAR),
    ):
        np.testing.assert_allclose(frames[0].priors[pair], np.linalg.inv(one) @ other, atol=1e-9)


def test_points_are_in_front_of_the_car_and_what_stands_still_comes_nearer(converted):
    name, _, _, frames = converted
    own = lidar_points(0.0)
    np.testing.assert_allclose(frames[0].lidar_xyz_m, own[:, :3], atol=1e-5)
    points = radar_points(0.0)
    assert len(frames[0].radar_x_m) == len(points)  # nuScenes' ambiguous point is left out
    np.testing.assert_allclose(frames[0].radar_y_m, points[:, 1], atol=1e-5)
    if name == "nuscenes":
        rate = -SPEED_MPS * points[:, 0] / np.hypot(points[:, 0], points[:, 1])
        np.testing.assert_array_equal(frames[0].lidar_ring, np.arange(len(own)) % 32)
    else:
        rate = points[:, 4]
    np.testing.assert_allclose(frames[0].radar_range_rate_mps, rate, atol=1e-4)


def test_the_car_drives_as_its_poses_say(converted):
    name, _, _, frames = converted
    speeds = [f.ego_speed_mps for f in frames]
    if name == "kitti":
        assert set(speeds) == {None}  # no poses, no odometry, and fleet.toml asks for none
    else:
        np.testing.assert_allclose(speeds, SPEED_MPS, atol=1e-3)
        np.testing.assert_allclose([f.ego_yaw_rate_radps for f in frames], 0, atol=1e-6)


def test_poses_that_turn_are_a_yaw_rate_to_the_left():
    T = [exp_se3(t * np.array([0, 0, 0.1, SPEED_MPS, 0, 0])) for t in (0.0, 0.5, 1.0)]
    for event in ego_events([0, 500_000_000, 1_000_000_000], T):
        assert event.load()[1:] == pytest.approx((SPEED_MPS, 0.1), rel=2e-3)


def test_check_finds_every_topic_but_semantics_and_has_no_complaint_about_the_radar(converted, capsys):
    _, folder, logs, _ = converted
    assert main(["check", str(folder / "fleet.toml"), *logs, "--json"]) in (1, 2)
    report = json.loads(capsys.readouterr().out)
    problems = {t["role"]: t["problem"] for t in report["topics"]}
    assert {role for role, problem in problems.items() if problem} == {"labels", "detections"}
    assert not any("oppler" in words or "backwards" in words for words in report["problems"])


def test_a_jump_of_the_poses_begins_another_drive(tmp_path):
    data_sets.view_of_delft(tmp_path / "data", frames=8, jump_at=5)
    _, frames = frames_in(tmp_path, "vod")
    assert [f.drive for f in frames] == [0] * 5 + [1] * 3
    np.testing.assert_allclose([f.ego_speed_mps for f in frames], SPEED_MPS, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "file", "content", "words"),
    [
        ("nuscenes", "v1.0-mini/sensor.json", b"[]", "scene.json: no scene has two sensors"),
        ("nuscenes", "v1.0-mini/sample.json", b"{", "sample.json: not readable JSON"),
        ("nuscenes", "v1.0-mini/sample_data.json", b'[{"token": "a"}]', "sample_data.json: calibrated_sensor"),
        ("nuscenes", "samples/LIDAR_TOP/0.pcd.bin", b"123", "0.pcd.bin: 3 bytes are not rows of 5 float32"),
        ("nuscenes", "samples/RADAR_FRONT/0.pcd", b"FIELDS x\n", "0.pcd: not a readable PCD"),
        ("vod", "lidar/training/calib/00000.txt", b"P2: 1 2\n", "00000.txt: P2: needs 12 numbers and has 2"),
        ("vod", "lidar/training/pose/00003.json", b'{"odomToCamera": [1]}', "odomToCamera: needs 16 numbers"),
        ("vod", "lidar/training/image_2/00000.jpg", b"", "00000.jpg: is not a readable image"),
        ("kitti", "calib/000000.txt", b"P2: one\n", "P2: is not a number"),
    ],
)  # fmt: skip
def test_a_broken_file_is_named_and_leaves_no_log(name, file, content, words, tmp_path, capsys):
    MAKERS[name](tmp_path / "data")
    (tmp_path / "data" / file).write_bytes(content)
    assert main(["convert", name, str(tmp_path / "data"), "--out", str(tmp_path / "out")]) == 2
    assert words in json.loads(capsys.readouterr().out.splitlines()[-1])["reason"]
    assert list(tmp_path.rglob("*.mcap")) == []


def topics_and_frames(path):
    """Of a log, by another reader than the pipeline's: messages by topic, child frames of /tf_static."""
    store, found = RosMessages(2).typestore, {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            found.setdefault(channel.topic, []).append(store.deserialize_cdr(message.data, schema.name))
    return found, {t.child_frame_id: t.transform for t in found["/tf_static"][0].transforms}


def test_nuscenes_brings_all_its_sensors_under_their_own_names(tmp_path):
    data_sets.nuscenes(tmp_path / "data")
    assert main(["convert", "nuscenes", str(tmp_path / "data"), "--out", str(tmp_path)]) == 0
    rig = load_fleet(tmp_path / "fleet.toml").rigs["default"]
    assert set(rig.cameras) == {"cam_front", "cam_back"}
    assert (set(rig.lidars), set(rig.radars), rig.base) == ({"lidar_top"}, {"radar_front"}, "base_link")
    found, frames = topics_and_frames(next((tmp_path / "logs").rglob("*.mcap")))
    assert set(frames) == set(rig.sensors)
    assert frames["cam_back"].translation.x == -1
    of_cameras = [topic for c in rig.cameras.values() for topic in (c.image, c.info)]
    for topic in (*of_cameras, rig.lidars["lidar_top"].points, rig.radars["radar_front"].points):
        assert len(found[topic]) == WHAT["nuscenes"][2], topic
    assert found[rig.cameras["cam_back"].image][0].header.frame_id == "cam_back"


def test_both_colour_cameras_of_kitti_are_taken_a_baseline_apart(tmp_path):
    data_sets.kitti(tmp_path / "data", second_camera=True)
    assert main(["convert", "kitti", str(tmp_path / "data"), "--out", str(tmp_path)]) == 0
    assert set(load_fleet(tmp_path / "fleet.toml").rigs["default"].cameras) == {"left", "right"}
    found, frames = topics_and_frames(next((tmp_path / "logs").rglob("*.mcap")))
    assert len(found["/camera/right/image/compressed"]) == WHAT["kitti"][2]
    # Frames of lidar axes: y to the left; the right camera's P3 has half a metre more of baseline.
    apart = frames["left"].translation.y - frames["right"].translation.y
    assert apart == pytest.approx(data_sets.BASELINE_M)


def test_models_are_named_in_fleet_toml_and_a_radar_without_doppler_is_refused(tmp_path, capsys):
    data_sets.kitti(tmp_path / "data", frames=1)
    call = ["convert", "kitti", str(tmp_path / "data"), "--out", str(tmp_path)]
    assert main([*call, "--radar-columns", "x,y,z,power,speed"]) == 2
    assert "lacks doppler" in capsys.readouterr().out
    assert main([*call, "--segmenter", "s.toml"]) == 2
    assert main([*call, "--segmenter", "s.toml", "--detector", "d.toml", "--vehicle", 'the "red" one']) == 0
    fleet = load_fleet(tmp_path / "fleet.toml")
    assert fleet.rigs["default"].camera.semantics.segmenter == "s.toml"
    assert list(fleet.vehicles) == ['the "red" one']


def transform_in(frame, prefix):
    parts = [getattr(frame, f"{prefix}_{p}") for p in ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")]
    return from_quaternion(np.array(parts[:4]), np.array(parts[4:]))


@pytest.fixture(scope="module")
def found_by_devkits(tmp_path_factory):
    python = os.environ.get("BORESIGHT_READERS")
    if not python:
        pytest.skip("BORESIGHT_READERS names no Python with the devkits: make readers")
    folder = tmp_path_factory.mktemp("devkits")
    paths = [str(MAKERS[name](folder / name)) for name in ("nuscenes", "vod")]
    script = Path(__file__).parent / "real_devkits.py"
    done = subprocess.run([python, script, *paths], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_the_data_sets_own_devkits_find_the_same_in_these_folders(converted, found_by_devkits):
    name, _, _, frames = converted
    if name == "kitti":
        pytest.skip("KITTI's own kit knows no radar")
    devkit = {key: np.array(value) for key, value in found_by_devkits[name].items() if key != "devkit"}
    frame = frames[0 if name == "nuscenes" else 3]
    np.testing.assert_allclose(frame.radar_xyz_m, devkit["radar"], atol=1e-5)
    T_lidar_radar = frame.priors["lidar_radar"]
    if name == "nuscenes":
        np.testing.assert_allclose(frame.lidar_xyz_m + T_BASE_LIDAR[:3, 3], devkit["lidar_base"], atol=1e-5)
        T_camera_radar = frame.priors["camera_lidar"] @ T_lidar_radar
        np.testing.assert_allclose(T_camera_radar, devkit["camera_radar"], atol=1e-9)
    else:
        np.testing.assert_allclose(frame.lidar_xyz_m, devkit["lidar"], atol=1e-5)
        np.testing.assert_allclose(frame.radar_range_rate_mps, devkit["range_rate"], atol=1e-5)
        np.testing.assert_allclose(
            T_lidar_radar, devkit["lidar_radar"], atol=1e-6
        )  # the devkit counts in float32
        np.testing.assert_allclose(transform_in(frame, "ego"), devkit["odom_lidar"], atol=1e-5)

"""Calibrations of rigs of many sensors, in every format: as many poses as sensors, the same numbers when read."""

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, ExportedPair, FrameNames, poses_of
from pipeline.export.formats import format_named
from pipeline.export.provenance import comment_lines
from pipeline.rig.graph import edge_named, words_of
from pipeline.rig.se3 import adjoint, exp_se3, inverse
from pipeline.store.commits import commit_records
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from schemas.poses import POSES
from tests.makers.calibrations import CAMERA, T_BASE_LIDAR, random_transform
from tests.makers.commands import command
from tests.makers.rig_records import EDGES, T_TOP, T_of, covariance_of, pose_rows, rig_records

NAMES = {"front": "cam_front_optical", "corner": "ars548_fl"}


def five(edges=EDGES, T=T_of, **values):
    """The five sensors; every edge says its own, so that ways which differ would show."""
    pairs = {words_of(e): ExportedPair(e, T(e), covariance_of(e)) for e in edges}
    fields = {
        "vehicle": "van-1", "source": "record of 2026-03-02", "method": "joint", "code_version": "0.11.0",
        "pairs": pairs, "edges": tuple(edges), "names": FrameNames(NAMES),
        "cameras": {"front": CAMERA, "left": CAMERA},
    }  # fmt: skip
    return ExportedCalibration(**fields | values)


def frame(sensor):
    return NAMES.get(sensor, sensor)


def test_a_pose_is_as_sure_as_the_edges_on_its_way():
    by_name = {pose.sensor: pose for pose in poses_of(five())}
    assert list(by_name) == ["front", "left", "bumper", "corner"]
    A = adjoint(inverse(T_of(EDGES[0])))
    np.testing.assert_allclose(by_name["front"].covariance, A @ covariance_of(EDGES[0]) @ A.T)
    far = edge_named("camera_radar", "left", "rear")
    chain = {pose.sensor: pose for pose in poses_of(five([*EDGES, far], lambda _edge: np.eye(4)))}
    whole = covariance_of(EDGES[1]) + covariance_of(far)  # all transforms are the identity
    np.testing.assert_allclose(chain["rear"].covariance, whole)


def test_camera_against_radar_ties_a_radar_only_where_nothing_else_does():
    rng = np.random.default_rng(3)
    off = exp_se3(np.r_[0, 0, 0.01, 0, 0, 0])
    sent = five(T=lambda e: off @ T_of(e) if e.kind == "camera_radar" else T_of(e))
    np.testing.assert_allclose(sent.T_root("bumper"), T_TOP["bumper"], atol=1e-12)
    rear = edge_named("camera_radar", "left", "rear")
    T_left_rear = random_transform(rng)
    sent = five([*EDGES, rear], lambda e: T_left_rear if e == rear else T_of(e))
    np.testing.assert_allclose(sent.T_root("rear"), T_TOP["left"] @ T_left_rear, atol=1e-12)


def test_an_edge_to_base_says_where_the_rig_sits_on_the_car():
    base = edge_named("lidar_base", "top", "base")
    sent = five([*EDGES, base], lambda e: inverse(T_BASE_LIDAR) if e == base else T_of(e), names=FrameNames())
    assert sent.root == "base_link"
    assert any(re.match("base_link -> top: .* sigma .* deg about", line) for line in comment_lines(sent))
    tree = format_named("urdf").tree(format_named("urdf").write(sent))
    np.testing.assert_allclose(tree.lookup("base_link", "front"), T_BASE_LIDAR @ T_TOP["front"], atol=1e-12)


def test_two_frames_of_one_name_are_refused_by_a_rig_s_own_sensors():
    with pytest.raises(ConfigError, match="must differ"):
        five(names=FrameNames({"front": "top"}))
    assert five(names=FrameNames({"front": "camera"})).names.of("front") == "camera"


def test_formats_of_cameras_have_a_part_per_camera_with_every_other_sensor():
    files = format_named("nuscenes").write(five())
    sensors, rows = (json.loads(files[f"{name}.json"]) for name in ("sensor", "calibrated_sensor"))
    assert {s["channel"]: s["modality"] for s in sensors} == {
        "cam_front_optical": "camera", "left": "camera", "top": "lidar", "ars548_fl": "radar", "bumper": "radar",
    }  # fmt: skip
    modality = {s["token"]: s["modality"] for s in sensors}
    for row in rows:
        is_camera = modality[row["sensor_token"]] == "camera"
        assert row["camera_intrinsic"] == (CAMERA.K.tolist() if is_camera else [])
    chain = yaml.safe_load(format_named("kalibr").write(five())["camchain.yaml"])
    assert list(chain) == ["cam0", "cam1"]
    for cam, sensor in zip(chain.values(), ("front", "left"), strict=True):
        assert cam["rostopic"] == f"/{frame(sensor)}/image_raw"
        for other in ("top", "bumper", "corner"):
            T = inverse(T_TOP[sensor]) @ T_TOP[other]
            np.testing.assert_allclose(cam[f"T_cam_{other}"], T, atol=1e-12)
    T_left_front = inverse(T_TOP["left"]) @ T_TOP["front"]
    np.testing.assert_allclose(chain["cam1"]["T_cn_cnm1"], T_left_front, atol=1e-12)
    assert "T_cn_cnm1" not in chain["cam0"]  # Kalibr asks it of all but the first
    assert set(format_named("kitti").write(five())) == {"calib_front.txt", "calib_left.txt"}
    text = format_named("opencv").write(five())["calibration.yaml"].decode()
    storage = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
    for camera in ("front", "left"):
        np.testing.assert_array_equal(storage.getNode(f"camera_matrix_{camera}").mat(), CAMERA.K)


@pytest.fixture
def lake(tmp_path):
    lake = Lake.at(tmp_path / "lake")
    commit_records(lake, CALIBRATIONS, rig_records("van", 2, np.random.default_rng(2)))
    return lake.root


OF_DAY = ("--vehicle", "van", "--day", "2026-03-01")


def test_commands_name_frames_of_any_sensor_and_the_file_is_as_the_day_it_was_written_from(
    lake, tmp_path, capsys
):
    call, urdf = ("export", "urdf", "--lake", lake, *OF_DAY, "--out"), tmp_path / "car.urdf"
    told = command(capsys, *call, urdf, "--frame", "front=cam_front", "--frame", "corner=ars548_fl")
    assert (told.code, told.summary["pairs"]) == (0, ["front-top", "left-top", "top-bumper", "top-corner"])
    tree = format_named("urdf").tree({"car.urdf": urdf.read_bytes()})
    assert set(tree.edges) == {"cam_front", "left", "bumper", "ars548_fl"}
    side = json.loads((tmp_path / "car.provenance.json").read_text())
    assert side["frame_names"]["corner"] == "ars548_fl"
    told = command(
        capsys, "compare", f"urdf:{urdf}", "2026-03-01", "--lake", lake, "--vehicle", "van", "--json"
    )
    found = json.loads(told.out)["pairs"]
    assert (told.code, len(found)) == (0, len(EDGES))
    tied = [p for p in found if p["pair"] != "front-bumper"]
    assert max(abs(axis["change"]) for p in tied for axis in p["axes"]) < 1e-9
    told = command(capsys, *call, tmp_path / "b", "--frame", "front")
    assert told.code == 2
    assert "'front' is not SENSOR=NAME" in told.summary["reason"]


def test_what_the_rig_does_without_is_exported_by_its_poses_and_not_by_what_the_edge_found(tmp_path, capsys):
    lake, left_out = Lake.at(tmp_path / "lake"), rig_records("van", 2, np.random.default_rng(2))
    commit_records(lake, CALIBRATIONS, [replace(r, used=False) for r in left_out])
    poses = pose_rows("van", 1, np.random.default_rng(8), of={(0, "corner"): {"status": "held"}})
    commit_records(lake, POSES, poses)
    told = command(capsys, "export", "urdf", "--lake", lake.root, *OF_DAY, "--out", tmp_path / "car.urdf")
    assert (told.code, told.summary["pairs"]) == (3, ["front-top", "left-top", "top-bumper"])
    assert told.summary["not_certified"]["top-corner"].startswith("held")
    tree = format_named("urdf").tree({"car.urdf": (tmp_path / "car.urdf").read_bytes()})
    assert {row.sensor for row in poses} - set(tree.edges) == {"top", "corner"}
    for row in poses:
        if row.sensor in tree.edges:
            np.testing.assert_allclose(tree.lookup("top", row.sensor), transform_of(row), atol=1e-9)

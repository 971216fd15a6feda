"""Calibrations of rigs of many sensors, in every format: as many poses as sensors, the same numbers when read."""

import json

import cv2
import numpy as np
import pytest
import xacro
import yaml

from jobs.cli import main
from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, ExportedPair, FrameNames, poses_of
from pipeline.export.files import write_files, written_files
from pipeline.export.formats import FORMATS, format_named
from pipeline.rig.edges import edge_named, words_of
from pipeline.rig.se3 import adjoint, exp_se3, inverse, to_quaternion
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from schemas.poses import POSES
from tests.makers.calibrations import CAMERA, T_BASE_LIDAR, random_transform
from tests.makers.rig_records import EDGES, T_TOP, T_of, covariance_of, pose_rows, rig_records
from tests.makers.table_rows import make_row

T_LINK_OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
NAMES = {"front": "cam_front_optical", "corner": "ars548_fl"}
RIG = """
[fleet]
name = "vans"
[rigs.van.prior]
source = "tf_static"
[rigs.van.cameras]
front = { image = "/f", info = "/fi" }
left = { image = "/l", info = "/li" }
[rigs.van.lidars]
top = { points = "/top" }
[rigs.van.radars]
bumper = { points = "/bumper" }
corner = { points = "/corner" }
[vehicles."*"]
rig = "van"
"""
TREES = [name for name in FORMATS if format_named(name).tree is not None and format_named(name).write]


def five(edges=EDGES, T=T_of, **values):
    """The five sensors; every edge says its own, so that ways which differ would show."""
    pairs = {words_of(e): ExportedPair(words_of(e), T(e), covariance_of(e), of=e) for e in edges}
    fields = {
        "vehicle": "van-1", "source": "record of 2026-03-02", "method": "joint", "code_version": "0.11.0",
        "pairs": pairs, "known": tuple(edges), "names": FrameNames.named(NAMES),
        "cameras": {"front": CAMERA, "left": CAMERA},
    }  # fmt: skip
    return ExportedCalibration(**fields | values)


def frame(sensor):
    return NAMES.get(sensor, sensor)


@pytest.mark.parametrize("name", TREES)
@pytest.mark.parametrize("mounted", [False, True])
def test_every_sensor_has_its_pose_in_every_format_that_holds_frames(name, mounted):
    sent = five(T_base_lidar=T_BASE_LIDAR if mounted else None)
    files = format_named(name).write(sent)
    tree = format_named(name).tree(files)
    for sensor in ("front", "left", "bumper", "corner"):
        T = tree.lookup("top", frame(sensor))
        if name == "autoware" and sensor in ("front", "left"):
            T = T @ T_LINK_OPTICAL
        np.testing.assert_allclose(T, T_TOP[sensor], atol=1e-12)
    if mounted and name not in ("nuscenes", "t4"):
        np.testing.assert_allclose(tree.lookup("base_link", "top"), T_BASE_LIDAR, atol=1e-12)


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


def test_a_sensor_whose_edge_is_left_out_has_no_pose_and_the_file_says_so():
    kept = [e for e in EDGES if e.child.name != "corner"]
    sent = five(kept, known=tuple(EDGES), left_out={"top-corner": "held: too few frames"})
    assert "corner" not in {pose.sensor for pose in poses_of(sent)}
    text = format_named("urdf").write(sent)["sensors.urdf"].decode()
    assert "WARNING: top-corner is left out: held: too few frames" in text
    assert 'link name="ars548_fl"' not in text


def test_an_edge_to_base_says_where_the_rig_sits_on_the_car():
    base = edge_named("lidar_base", "top", "base")
    sent = five([*EDGES, base], lambda e: inverse(T_BASE_LIDAR) if e == base else T_of(e), names=FrameNames())
    assert sent.root == "base_link"
    tree = format_named("urdf").tree(format_named("urdf").write(sent))
    np.testing.assert_allclose(tree.lookup("base_link", "front"), T_BASE_LIDAR @ T_TOP["front"], atol=1e-12)


def test_two_frames_of_one_name_are_refused_by_a_rig_s_own_sensors():
    with pytest.raises(ConfigError, match="must differ"):
        five(names=FrameNames.named({"front": "top"}))
    assert five(names=FrameNames.named({"front": "camera"})).names.of("front") == "camera"


def test_autoware_s_kit_of_five_expands_with_xacro_to_its_yaml(tmp_path):
    write_files(written_files(format_named("autoware"), five(), tmp_path))
    car = tmp_path / "car.xacro"
    car.write_text(f"""<robot name="car" xmlns:xacro="http://ros.org/wiki/xacro">
<xacro:include filename="{tmp_path}/sensor_kit.xacro"/><link name="base_link"/>
<xacro:sensor_kit_macro parent="base_link" x="0.9" y="0" z="2" roll="0" pitch="0" yaw="0" config_dir="{tmp_path}"/>
</robot>""")
    tree = format_named("urdf").tree({"car": xacro.process_file(str(car)).toxml().encode()})
    for sensor, T in T_TOP.items():
        optical = T_LINK_OPTICAL if sensor in ("front", "left") else np.eye(4)
        found = tree.lookup("sensor_kit_base_link", frame(sensor))
        np.testing.assert_allclose(found @ optical, T, atol=1e-12)


def test_nuscenes_has_a_row_per_sensor_with_its_modality_and_each_camera_s_intrinsics():
    files = format_named("nuscenes").write(five())
    sensors, rows = (json.loads(files[f"{name}.json"]) for name in ("sensor", "calibrated_sensor"))
    assert {s["channel"]: s["modality"] for s in sensors} == {
        "cam_front_optical": "camera", "left": "camera", "top": "lidar", "ars548_fl": "radar", "bumper": "radar",
    }  # fmt: skip
    of_token = {s["token"]: s["modality"] for s in sensors}
    for row in rows:
        is_camera = of_token[row["sensor_token"]] == "camera"
        assert row["camera_intrinsic"] == (CAMERA.K.tolist() if is_camera else [])


def test_kalibr_has_a_chain_of_cameras_each_with_the_other_sensors():
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


def test_kitti_has_a_file_per_camera_with_a_line_per_radar():
    files = format_named("kitti").write(five())
    assert set(files) == {"calib_front.txt", "calib_left.txt"}
    for sensor in ("front", "left"):
        lines = dict(line.split(": ") for line in files[f"calib_{sensor}.txt"].decode().splitlines())
        for name, T in (
            ("Tr_velo_to_cam", inverse(T_TOP[sensor])),
            ("Tr_bumper_to_velo", T_TOP["bumper"]),
            ("Tr_corner_to_velo", T_TOP["corner"]),
        ):
            np.testing.assert_allclose(
                np.reshape(lines[name].split(), (3, 4)).astype(float), T[:3], atol=1e-12
            )


def test_opencv_has_every_edge_under_a_name_that_it_can_read():
    text = format_named("opencv").write(five())["calibration.yaml"].decode()
    storage = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
    for edge in EDGES:
        name = f"T_{edge.parent.name}_{edge.child.name}"
        assert name.isidentifier()
        np.testing.assert_array_equal(storage.getNode(name).mat(), T_of(edge))
    for camera in ("front", "left"):
        np.testing.assert_array_equal(storage.getNode(f"camera_matrix_{camera}").mat(), CAMERA.K)


@pytest.fixture
def lake(tmp_path):
    lake = Lake.at(tmp_path / "lake")
    commit_records(lake, CALIBRATIONS, rig_records("van", 2, np.random.default_rng(2)))
    return lake.root


def said(capsys, *arguments):
    code = main([str(a) for a in arguments])
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def test_commands_name_frames_of_any_sensor_and_write_all_of_them(lake, tmp_path, capsys):
    of_van = ("--lake", lake, "--vehicle", "van", "--day", "2026-03-01")
    asked = ("--frame", "front=cam_front", "--frame", "corner=ars548_fl")
    code, summary = said(capsys, "export", "urdf", "--out", tmp_path / "car.urdf", *of_van, *asked)
    assert (code, summary["pairs"]) == (0, ["front-top", "left-top", "top-bumper", "top-corner"])
    tree = format_named("urdf").tree({"car.urdf": (tmp_path / "car.urdf").read_bytes()})
    assert set(tree.edges) == {"cam_front", "left", "bumper", "ars548_fl"}
    side = json.loads((tmp_path / "car.provenance.json").read_text())
    assert side["frame_names"]["corner"] == "ars548_fl"
    code, summary = said(capsys, "export", "urdf", "--out", tmp_path / "b", *of_van, "--frame", "front")
    assert code == 2
    assert "'front' is not SENSOR=NAME" in summary["reason"]


def test_a_day_whose_rig_was_adjusted_is_exported_by_its_poses(lake, tmp_path, capsys):
    rng, moved = np.random.default_rng(8), exp_se3(np.r_[0, 0, 0.004, 0.01, 0, 0])
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    for sensor, kind, status in (
        ("front", "camera", "accepted"), ("left", "camera", "accepted"),
        ("bumper", "radar", "accepted"), ("corner", "radar", "held"),
    ):  # fmt: skip
        T = moved @ T_TOP[sensor]
        pose = dict(zip(names, (*to_quaternion(T).tolist(), *T[:3, 3].tolist()), strict=True))
        row = make_row(
            "poses", rng, vehicle="van", day="2026-03-01", method="joint", sensor=sensor, kind=kind, reference="top",
            status=status, determined=["azimuth", "elevation"], observable=[True] * 6, recorded_at="", asserted_at="",
            covariance=np.eye(6) * 1e-6, common_covariance=np.eye(6) * 1e-7, **pose,
        )  # fmt: skip
        commit_records(Lake.at(lake), POSES, [row])
    of_van = ("--lake", lake, "--vehicle", "van", "--day", "2026-03-01")
    code, summary = said(capsys, "export", "urdf", "--out", tmp_path / "car.urdf", *of_van)
    assert (code, summary["pairs"]) == (3, ["front-top", "left-top", "top-bumper"])
    assert summary["not_certified"]["top-corner"].startswith("held")
    tree = format_named("urdf").tree({"car.urdf": (tmp_path / "car.urdf").read_bytes()})
    for sensor in ("front", "left", "bumper"):
        np.testing.assert_allclose(tree.lookup("top", sensor), moved @ T_TOP[sensor], atol=1e-9)
    assert tree.lookup("top", "corner") is None


def test_a_camera_frame_option_is_that_of_the_sensor_called_camera():
    from jobs.frame_options import FrameOptions

    assert FrameOptions(camera="c").names() == FrameOptions(frame=("camera=c",)).names()


def test_two_days_of_five_sensors_are_compared_edge_by_edge(lake, capsys):
    call = ("compare", "2026-03-01", "2026-03-02", "--lake", lake, "--vehicle", "van", "--json")
    assert main([str(a) for a in call]) == 0
    found = json.loads(capsys.readouterr().out)["pairs"]
    assert [(p["parent_frame"], p["child_frame"]) for p in found] == [
        (e.parent.name, e.child.name) for e in EDGES
    ]
    assert max(abs(axis["z"]) for p in found for axis in p["axes"]) < 5


@pytest.mark.parametrize("form", [f for f in FORMATS if format_named(f).write is not None])
def test_what_was_written_of_five_sensors_is_compared_with_the_lake_it_came_from(form):
    sent = five()
    files = format_named(form).write(sent)
    found = format_named(form).pairs(files, sent.names, EDGES)
    assert {"front-top", "left-top", "top-bumper", "top-corner"} <= found.keys()
    for edge in EDGES:
        if words_of(edge) in found:
            np.testing.assert_allclose(found[words_of(edge)], T_of(edge), atol=1e-12)


def test_a_file_of_five_sensors_is_held_against_the_day_that_it_was_written_from(lake, tmp_path, capsys):
    of_van = ("--lake", lake, "--vehicle", "van")
    asked = ("--day", "2026-03-01", "--frame", "front=cam_front")
    assert said(capsys, "export", "urdf", "--out", tmp_path / "car.urdf", *of_van, *asked)[0] == 0
    assert (
        main([str(a) for a in ("compare", f"urdf:{tmp_path}/car.urdf", "2026-03-01", *of_van, "--json")]) == 0
    )
    found = json.loads(capsys.readouterr().out)["pairs"]
    assert len(found) == len(EDGES)
    tied = [p for p in found if p["pair"] != "front-bumper"]
    assert max(abs(axis["change"]) for p in tied for axis in p["axes"]) < 1e-9


@pytest.fixture
def with_state(tmp_path):
    """A lake with the state of five sensors, of which the left camera has no usable day."""
    lake, refused = Lake.at(tmp_path / "lake"), {"status": "refused", "reason": "nothing to see", "qw": None}
    rows = pose_rows("van", 3, np.random.default_rng(5), of={(k, "left"): refused for k in range(3)})
    commit_records(lake, CALIBRATIONS, rig_records("van", 3, np.random.default_rng(2)))
    commit_records(lake, POSES, rows)
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(RIG)
    assert main(["audit", "--fleet", str(fleet), "--lake", str(lake.root)]) == 0
    return lake.root


@pytest.mark.parametrize("form", ["kitti", "nuscenes", "t4", "kalibr"])
def test_a_state_of_days_whose_observations_are_gone_has_no_intrinsics(with_state, tmp_path, capsys, form):
    call = ("export", form, "--out", tmp_path / "out", "--lake", with_state, "--vehicle", "van")
    code, summary = said(capsys, *call)
    assert code == 2
    assert "front: the format needs intrinsics" in summary["reason"]


def test_a_state_is_compared_with_the_file_that_was_written_of_it(with_state, tmp_path, capsys):
    of_van = ("--lake", with_state, "--vehicle", "van")
    said(capsys, "export", "urdf", "--out", tmp_path / "car.urdf", *of_van)
    assert main([str(a) for a in ("compare", f"urdf:{tmp_path}/car.urdf", "state", *of_van, "--json")]) == 0
    found = json.loads(capsys.readouterr().out)["pairs"]
    assert {p["pair"] for p in found} == {"front-top", "left-top", "top-bumper", "top-corner"}
    assert max(abs(axis["change"]) for p in found for axis in p["axes"]) < 1e-9


def test_the_state_of_a_rig_is_a_line_per_sensor(with_state, capsys):
    capsys.readouterr()
    assert main(["state", "--lake", str(with_state)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("van, 2026-03-03, joint: load bumper, corner, front; keep left at the prior\n")
    assert "top -> front: current, 3 days from 2026-03-01 to 2026-03-03" in out
    assert "no usable day; 2026-03-03 refused: nothing to see" in out
    assert "front-top" not in out
    assert max(map(len, out.splitlines())) <= 80
    assert main(["state", "--lake", str(with_state), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {r["sensor"] for r in rows} == {None, "top", "front", "left", "bumper", "corner"}
    np.testing.assert_allclose({r["sensor"]: r["T"] for r in rows}["left"], T_TOP["left"], atol=1e-12)

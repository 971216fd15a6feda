"""One pose per sensor of what a vehicle should load: state, page and every file have the same numbers and words."""

import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader

from pipeline.core.config import FleetConfig
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT, STATE
from pipeline.export.calibration import ExportedCalibration, ExportedPair, FrameNames, replaced_transforms
from pipeline.export.formats import FORMATS, format_named
from pipeline.report.stage import write_day_page
from pipeline.report.words import pose_text
from pipeline.rig.graph import edge_named, words_of
from pipeline.rig.prior import to_rows
from pipeline.rig.se3 import change_covariance, exp_se3, inverse
from pipeline.store.commits import commit_records
from pipeline.store.moments import write_moments
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS
from schemas.moments import PERCEIVED
from schemas.poses import POSES
from schemas.states import STATES, StateRow
from tests.audit.fleet_records import T_LIDAR_RADAR, poses_of, vehicle_records
from tests.makers.calibrations import CAMERA, T_BASE_LIDAR
from tests.makers.commands import command
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.lakes import joined_of, write_frames, write_observations
from tests.makers.rig_records import T_TOP, pose_rows, rig_records
from tests.makers.table_rows import make_observation

LAST = "2026-03-04"
REFUSED = {"status": "refused", "reason": "nothing to see", "qw": None}
ROLLED = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])  # of the car's radar, in its own axes [rad]
FRAME_IDS = {"camera": ["front_optical"], "lidar": ["/roof"], "radar": ["radar_front"]}
LOGGED = {
    ("base_link", "roof"): T_BASE_LIDAR,
    ("base_link", "camera_link"): exp_se3(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 1.5])),
    ("camera_link", "front_optical"): np.eye(4),
    ("base_link", "radar_front"): T_BASE_LIDAR @ T_LIDAR_RADAR,
}
# By vehicle: its sensors with their kinds, the reference first, and the frames that its logs name.
SENSORS = {
    "car": {"lidar": "lidar", "camera": "camera", "radar": "radar"},
    "van": {"top": "lidar", "front": "camera", "left": "camera", "bumper": "radar", "corner": "radar"},
}
FRAMES = {"car": {s: ids[0].lstrip("/") for s, ids in FRAME_IDS.items()}, "van": {}}
WRITTEN = [name for name in FORMATS if format_named(name).write is not None]
# Formats that hold the edges' matrices as text; Kalibr's hold the cameras' so. The others hold poses or angles.
EXACT = {"opencv": "lidar camera radar", "kitti": "lidar camera radar", "kalibr": "camera"}
COMMENTED = {"ros2", "urdf", "xacro", "autoware", "kalibr", "opencv"}


@pytest.fixture(scope="module")
def fleet():
    return FleetConfig.model_validate({"fleet": {"name": "test"}, "rigs": {"default": THREE_SENSORS}})


@pytest.fixture(scope="module")
def lake(tmp_path_factory, fleet):
    """A car of three sensors, a van of five whose left camera has no usable day, and a car that has none at all."""
    tables = Lake.at(tmp_path_factory.mktemp("one_pose") / "lake")
    rng = np.random.default_rng(1)
    records = vehicle_records("car", 4, rng, motion=lambda _: {"radar": ROLLED}, unobservable=(5,))
    records = [replace(r, determined=["azimuth"]) for r in records]
    records += vehicle_records("new", 2, rng, status=lambda _: "refused")
    commit_records(tables, CALIBRATIONS, records + rig_records("van", 4, rng))
    of_van = pose_rows("van", 4, rng, of={(k, "left"): REFUSED for k in range(4)})
    commit_records(tables, POSES, poses_of(records) + of_van)
    for stage in (AUDIT, STATE):
        stage.run(Task(fleet, tables, Window()))
    seen = make_observation(
        rng, nulls=True, camera_model=CAMERA.model, camera_K=CAMERA.K, camera_D=CAMERA.D,
        image_width_px=CAMERA.width_px, image_height_px=CAMERA.height_px,
    )  # fmt: skip
    write_frames(tables, Partition("car", LAST), [], "key", frame_ids=FRAME_IDS, tf_static=to_rows([LOGGED]))
    write_observations(tables, Partition("car", LAST), [seen], "key")
    moment, parts = joined_of(seen)
    with write_moments(tables, PERCEIVED, Partition("van", LAST), "key") as writer:
        writer.append(moment, {name: parts[kind] for name, kind in SENSORS["van"].items()})
        writer.describe(kept={"frames": 1}, rejected={})
    return tables.root


def export(capsys, lake, vehicle, form, out, *options):
    """What the command returns and prints, and the content of its files by name."""
    told = command(capsys, "export", form, "--lake", lake, "--vehicle", vehicle, "--out", out, *options)
    return told, {p.name: p.read_bytes() for p in out.rglob("*") if p.is_file()} if out.exists() else {}


def states_of(capsys, lake, vehicle):
    """Rows of `boresight state --json`: by sensor, by name of the edge, and all of them."""
    rows = json.loads(command(capsys, "state", "--lake", lake, "--vehicle", vehicle, "--json").out)
    edges = [r for r in rows if r["sensor"] is None]
    named = {words_of(edge_named(r["pair"], r["parent_frame"], r["child_frame"])): r for r in edges}
    return {r["sensor"]: r for r in rows if r["sensor"] is not None}, named, rows


def sigmas(row):
    """Of the rotation about the parent's axes [rad] and of the child's origin [m]."""
    return np.sqrt(np.diag(change_covariance(np.array(row["T"]), np.array(row["covariance"]))))


def side_of(files):
    """The provenance beside the files, or in a log's metadata."""
    for name, content in files.items():
        if name.endswith(".provenance.json"):
            return json.loads(content)
        if name.endswith(".mcap"):
            [held] = make_reader(io.BytesIO(content)).iter_metadata()
            return json.loads(held.metadata["provenance"])
    raise AssertionError(f"no provenance among {sorted(files)}")


@pytest.mark.parametrize("vehicle", ["car", "van"])
@pytest.mark.parametrize("form", WRITTEN)
def test_every_format_of_a_state_reads_back_as_the_one_pose_of_each_sensor(
    lake, tmp_path, capsys, form, vehicle
):
    sensors, edges, _ = states_of(capsys, lake, vehicle)
    reference, *others = SENSORS[vehicle]
    said, files = export(capsys, lake, vehicle, form, tmp_path / "out")
    assert said.code == (3 if vehicle == "van" else 0)
    frames = {} if form == "autoware" else FRAMES[vehicle]
    tied = {
        name: (other, row)
        for name, row in edges.items()
        if reference in (ends := {row["parent_frame"], row["child_frame"]})
        for other in ends - {reference}
    }
    assert {other for other, _ in tied.values()} == set(others)
    own = {n: content for n, content in files.items() if "provenance" not in n}
    asked = [edge_named(row["pair"], row["parent_frame"], row["child_frame"]) for _, row in tied.values()]
    found = format_named(form).pairs(own, FrameNames(frames), asked)
    side, text = side_of(files), b"".join(own.values()).decode(errors="replace")
    for name, (other, row) in tied.items():
        T, kind = np.array(row["T"]), SENSORS[vehicle][other]
        to_last_digit = 0 if kind in EXACT.get(form, "").split() else 1e-12
        assert np.abs(found[name] - T).max() <= to_last_digit, name
        of_sensor = T if row["parent_frame"] == reference else inverse(T)
        np.testing.assert_allclose(sensors[other]["T"], of_sensor, atol=1e-12)
        told = side["pairs"][name]
        assert told[f"T_{row['parent_frame']}_{row['child_frame']}"] == row["T"]
        assert told["covariance"] == row["covariance"]
        np.testing.assert_array_equal(list(told["sigma"].values()), sigmas(row))
        for column in ("azimuth_sigma_rad", "elevation_sigma_rad", "reason", "status", "in_words"):
            assert told[column] == row[column]
        for column in ("azimuth_sigma_rad", "elevation_sigma_rad", "status", "determined"):
            assert row[column] == sensors[other][column], column
        assert row["reason"].endswith(sensors[other]["reason"])
        assert f"{name}: {row['in_words']}" in said.err
        pose = next(p for p in side["poses"] if p["child"] == FrameNames(frames).of(other))
        np.testing.assert_allclose(pose["T_parent_child"], sensors[other]["T"], atol=1e-12)
        np.testing.assert_allclose(list(pose["sigma"].values()), sigmas(sensors[other]), rtol=1e-9)
        if form in COMMENTED:
            turn, shift = np.degrees(sigmas(sensors[other])[:3]), sigmas(sensors[other])[3:]
            ends = f"{frames.get(reference, reference)} -> {frames.get(other, other)}".replace("--", "- -")
            numbers = " ".join(f"{v:.4f}" for v in turn), " ".join(f"{v:.4f}" for v in shift)
            assert re.search(rf"{ends}: .* sigma {numbers[0]} deg about and {numbers[1]} m", text)
            assert f"{name}: {row['in_words']}" in text
    if form == "opencv":
        import cv2

        storage = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
        for row in edges.values():
            held = f"{row['parent_frame']}_{row['child_frame']}"
            if not storage.getNode(f"T_{held}").empty():
                np.testing.assert_array_equal(storage.getNode(f"covariance_{held}").mat(), row["covariance"])


@pytest.mark.parametrize("vehicle", ["car", "van"])
def test_the_page_has_the_rows_of_the_state_and_copies_them_as_json(lake, fleet, tmp_path, capsys, vehicle):
    sensors, _, rows = states_of(capsys, lake, vehicle)
    day = Partition(vehicle, LAST)
    text = write_day_page(Lake.existing(lake), day, fleet, tmp_path / "d.html", pictures=False).read_text()
    assert ("The rig from above" in text) == (vehicle == "van")  # of sensors that have names of their own
    [copied] = re.findall(r'<script type="application/json" id="json-state">(.*?)</script>', text)
    own = [{k: v for k, v in row.items() if k not in ("pose", "sigma")} for row in json.loads(copied)]
    assert own == [{k: v for k, v in row.items() if k != "signed_by"} for row in rows]
    assert "tonight&#39;s state" in text[: text.index("<h2>Load tonight")]  # the answer is on the state
    shown = text[text.index("<h2>Load tonight") : text.index("This day's records")]
    for name in list(SENSORS[vehicle])[1:]:
        row = sensors[name]
        azimuth, elevation = np.degrees([row["azimuth_sigma_rad"], row["elevation_sigma_rad"]])
        for words in (
            pose_text(np.array(row["T"])),
            f"{azimuth:.3f} / {elevation:.3f}",
            row["in_words"],
            row["status"],
        ):
            assert words in shown


def test_frames_are_named_as_in_the_logs_and_come_back_without_being_named(lake, tmp_path, capsys):
    for options, names in (
        ([], ("front_optical", "roof", "radar_front")),
        (["--generic-frames"], ("camera", "lidar", "radar")),
        (["--radar-frame", "bumper"], ("front_optical", "roof", "bumper")),
    ):
        out = tmp_path / f"{names[2]}.urdf"
        command(capsys, "export", "urdf", "--lake", lake, "--vehicle", "car", *options, "--out", out)
        assert all(f'link name="{name}"' in out.read_text() for name in names)
        assert command(capsys, "import", "urdf", out, "--out", tmp_path / "prior.json").code == 0
    _, files = export(capsys, lake, "car", "autoware", tmp_path / "kit")
    assert b"front_optical" not in files["sensor_kit_calibration.yaml"]


def test_a_sensor_without_usable_days_is_in_the_launch_file_at_its_prior_and_named(lake, tmp_path, capsys):
    said, files = export(capsys, lake, "van", "ros2", tmp_path / "out")
    assert (said.code, said.summary["status"]) == (3, "partly")
    for name in ("static_transforms.launch.py", "static_transforms.launch.yaml"):
        tree = format_named("ros2").tree({name: files[name]})
        np.testing.assert_allclose(tree.lookup("top", "left"), T_TOP["left"], atol=1e-12)
        text = files[name].decode()
        why = "left-top: left is at its prior: no usable day; 2026-03-04 refused: nothing to see"
        assert f"# WARNING: {why}" in text
        assert "# left-top: used: nothing; certified: nothing; at the prior: pitch, yaw, roll" in text
    assert why in said.err
    assert said.summary["not_certified"]["left-top"].startswith("left is at its prior: no usable day")


def test_a_state_is_as_the_file_that_was_written_of_it_and_a_line_per_sensor(lake, tmp_path, capsys):
    of_van, urdf = ("--lake", lake, "--vehicle", "van"), tmp_path / "car.urdf"
    command(capsys, "export", "urdf", "--out", urdf, *of_van)
    found = json.loads(command(capsys, "compare", f"urdf:{urdf}", "state", *of_van, "--json").out)["pairs"]
    assert {p["pair"] for p in found} == {"front-top", "left-top", "top-bumper", "top-corner"}
    assert max(abs(axis["change"]) for p in found for axis in p["axes"]) < 1e-9
    out = command(capsys, "state", *of_van).out
    assert out.startswith(f"van, {LAST}, joint: load bumper, corner, front; keep left at the prior\n")
    assert f"top -> front: current, 4 days from 2026-03-01 to {LAST}" in out
    assert f"no usable day; {LAST} refused: nothing to see" in out
    assert "front-top" not in out
    assert max(map(len, out.splitlines())) <= 80


def test_the_tree_has_the_root_of_the_car_s_own_tf_and_names_what_it_replaces(lake, tmp_path, capsys):
    sensors, *_ = states_of(capsys, lake, "car")
    said, files = export(capsys, lake, "car", "ros2", tmp_path / "out")
    tree = format_named("ros2").tree({n: files[n] for n in files if "launch" in n})
    assert tree.edges == {"roof": "base_link", "front_optical": "roof", "radar_front": "roof"}
    np.testing.assert_allclose(tree.lookup("base_link", "roof"), T_BASE_LIDAR, atol=1e-12)
    wanted = T_BASE_LIDAR @ np.array(sensors["radar"]["T"])
    np.testing.assert_allclose(tree.lookup("base_link", "radar_front"), wanted, atol=1e-12)
    replaced = ["camera_link -> front_optical", "base_link -> radar_front", "base_link -> roof"]
    assert side_of(files)["replaces_in_tf_static"] == replaced
    words = f"a frame has one parent: remove from the car's own /tf_static what this replaces: {', '.join(replaced)}"
    assert words in said.err
    assert words in files["static_transforms.launch.yaml"].decode()


@pytest.mark.parametrize(
    ("own", "replaced"),
    [
        ({"top": "base_link", "front": "base_link", "gnss": "base_link"}, ["base_link -> front"]),
        ({"mast": "front", "top": "mast"}, ["mast -> top"]),  # the front camera would be above itself
        ({"top": "mast", "mast": "top"}, []),  # a loop of the car's own
    ],
)
def test_what_would_give_a_frame_two_parents_or_a_place_above_itself_is_replaced(own, replaced):
    edge = edge_named("camera_lidar", "front", "top")
    pairs = {"front-top": ExportedPair(edge, inverse(T_TOP["front"]))}
    sent = ExportedCalibration("v", "", "joint", "", pairs, (edge,), own_tree=own)
    assert replaced_transforms(sent) == replaced


def test_a_camera_at_its_prior_without_an_edge_of_its_own_uses_nothing(lake, tmp_path, capsys):
    """Its pose is turned round, and with it what the days determine."""
    states = read_records(Lake.existing(lake), STATES, StateRow, vehicle="van")
    other = Lake.at(tmp_path / "lake")
    commit_records(other, STATES, [r for r in states if (r.parent_frame, r.child_frame) != ("left", "top")])
    _, files = export(capsys, other.root, "van", "urdf", tmp_path / "out")
    left = side_of(files)["pairs"]["left-top"]
    assert left["in_words"].startswith("used: nothing; certified: nothing; at the prior: pitch, yaw, roll, ")
    assert left["reason"] == "no usable day; 2026-03-04 refused: nothing to see"


def test_a_vehicle_without_any_usable_day_gets_its_priors_and_exit_code_4(lake, tmp_path, capsys):
    said, files = export(capsys, lake, "new", "urdf", tmp_path / "out")
    assert (said.code, said.summary["status"]) == (4, "held")
    found = format_named("urdf").pairs({"f": files["sensors.urdf"]}, FrameNames())
    np.testing.assert_allclose(found["lidar_radar"], T_LIDAR_RADAR, atol=1e-12)
    for pair in side_of(files)["pairs"].values():
        assert (pair["status"], pair["certified"]) == ("prior", [])


def test_force_has_nothing_to_force_in_a_state(lake, tmp_path, capsys):
    said, files = export(capsys, lake, "van", "ros2", tmp_path / "out", "--force")
    assert (said.code, files) == (2, {})
    assert "leave out --force" in said.summary["reason"]

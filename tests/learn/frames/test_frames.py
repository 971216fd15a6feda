"""`boresight export frames`: what was in the lake comes out of every format, whole, split and with its calibration."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import pipeline.store.object_store
from jobs.cli import main
from pipeline.learn.frames.nuscenes import undistortion_of
from pipeline.learn.frames.torch_dataset import Frames
from pipeline.rig.se3 import exp_se3, inverse, log_so3, to_quaternion
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.views import frames_of
from schemas.states import STATES, StateRow
from tests.makers import training_lakes
from tests.makers.fleet_files import fleet_toml
from tests.makers.s3_server import BUCKET, running

VEHICLES, DAYS = ("a", "b", "c"), ("2026-01-01", "2026-01-02")
EGO = {
    "ego_speed_mps": 10.0, "ego_yaw_rate_radps": 0.1, "ego_qw": 1.0, "ego_qx": 0.0, "ego_qy": 0.0, "ego_qz": 0.0,
    "ego_tx_m": 5.0, "ego_ty_m": 7.0, "ego_tz_m": 0.0,
}  # fmt: skip
NO_POSE = dict.fromkeys(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m", "covariance"))
SECTION = '[prepare.split]\nby = "vehicle"\nval_fraction = 0.2\ntest_fraction = 0.2'
ONE_SPLIT = '[prepare.split]\nby = "day"\nval_fraction = 0\ntest_fraction = 0'


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """Three vehicles on two days, four frames each."""
    folder = tmp_path_factory.mktemp("lake")
    (folder / "fleet.toml").write_text(fleet_toml(*VEHICLES, sections=SECTION))
    for vehicle in VEHICLES:
        for day in DAYS:
            training_lakes.fill(Lake.at(folder), vehicle, day, frames=4, **EGO)
    return folder


def command(lake, out, form, *more, of=None, fleet=None):
    """The words of a command; calibrations are the priors unless asked for otherwise."""
    places = {"--fleet": fleet or lake / "fleet.toml", "--lake": of or lake, "--out": out, "--format": form}
    source = [] if "--calibration" in more else ["--calibration", "prior"]
    words = [str(word) for place in places.items() for word in place]
    return ["export", "frames", *words, "--executor", "inline", *source, *more]


def export(lake, out, form, *more, code=0, fleet=None):
    assert main(command(lake, out, form, *more, fleet=fleet)) == code
    return None if code else json.loads((Path(out) / "card.json").read_text())


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def lake_frames(lake):
    return {
        (v, d, f.frame_index): f
        for v in VEHICLES
        for d in DAYS
        for f in frames_of(Lake.at(lake), Partition(v, d))
    }


def assert_same_points(sensors, frame):
    np.testing.assert_array_equal(sensors["lidar"][:, :3], frame.lidar_xyz_m)
    np.testing.assert_array_equal(sensors["lidar"][:, 3], frame.lidar_intensity)
    np.testing.assert_array_equal(sensors["radar"][:, :3], frame.radar_xyz_m)
    np.testing.assert_array_equal(sensors["radar"][:, 3], frame.radar_range_rate_mps)


def test_files_hold_every_frame_once(lake, tmp_path):
    card, wanted = export(lake, tmp_path, "parquet"), lake_frames(lake)
    assert sum(card["frames"].values()) == len(wanted) == 24
    assert all(card["frames"].values())
    assert all(name.startswith(f"{split}/") for split, names in card["files"].items() for name in names)
    of = {split: list(Frames(str(tmp_path), split)) for split in card["files"]}
    vehicles = [{found["vehicle"] for found in own} for own in of.values()]
    assert set.union(*vehicles) == set(VEHICLES)
    assert sum(map(len, vehicles)) == len(VEHICLES)  # no split shares one
    frames = [found for own in of.values() for found in own]
    assert len({found["key"] for found in frames}) == 24
    for found in frames:
        frame, sensors = wanted[found["vehicle"], found["day"], found["moment"]], found["sensors"]
        assert bytes(sensors["camera"]["image"].numpy()) == frame.image
        assert_same_points({n: sensors[n]["points"].numpy() for n in ("lidar", "radar")}, frame)
        assert cv2.imdecode(sensors["camera"]["labels_png"].numpy(), -1) is not None
        T = {n: np.array(sensors[n]["T_reference_sensor"]) for n in ("camera", "lidar", "radar")}
        np.testing.assert_allclose(inverse(T["camera"]) @ T["lidar"], frame.priors["camera_lidar"], atol=1e-9)
        np.testing.assert_allclose(inverse(T["lidar"]) @ T["radar"], frame.priors["lidar_radar"], atol=1e-9)


@pytest.mark.slow
def test_two_workers_of_torch_read_parquet_by_the_copy_of_the_dataset_that_lies_beside_it(lake, tmp_path):
    export(lake, tmp_path, "parquet")
    (tmp_path / "use.py").write_text(
        "import torch\nfrom dataset import Frames\n"
        "if __name__ == '__main__':\n"
        "    data = torch.utils.data.DataLoader(Frames('.', 'train'), num_workers=2, batch_size=3, collate_fn=list)\n"
        "    seen = [f for batch in data for f in batch]\n"
        "    assert all(f['sensors']['camera']['image'].dtype == torch.uint8 for f in seen)\n"
        '    print(*(f\'{f["key"]}:{len(f["sensors"]["lidar"]["points"])}\' for f in seen))\n'
    )
    environment = {n: v for n, v in os.environ.items() if n != "PYTHONPATH"}  # without this project
    call = [sys.executable, "use.py"]
    out = subprocess.run(
        call, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    ).stdout.split()
    own = [f"{f['key']}:{len(f['sensors']['lidar']['points'])}" for f in Frames(str(tmp_path), "train")]
    assert out == own
    assert len(own) >= 8
    frame = Frames(str(tmp_path), "train")[0]
    points = {n: frame["sensors"][n]["points"].numpy() for n in ("lidar", "radar")}
    assert_same_points(points, lake_frames(lake)[frame["vehicle"], frame["day"], frame["moment"]])
    assert isinstance(frame["sensors"]["lidar"]["points"], torch.Tensor)


def test_frames_come_back_through_convert_and_ingest(lake, tmp_path):
    toml, again = tmp_path / "fleet.toml", Lake.at(tmp_path / "again")
    toml.write_text(fleet_toml("a", sections=ONE_SPLIT))
    export(lake, tmp_path / "out", "nuscenes", "--to", DAYS[0], fleet=toml)
    assert main(["convert", "nuscenes", str(tmp_path / "out"), "--out", str(tmp_path / "logs")]) == 0
    logs = [str(p) for p in (tmp_path / "logs" / "logs" / "a" / DAYS[0]).iterdir()]
    call = ["ingest", *logs, "--fleet", str(tmp_path / "logs" / "fleet.toml"), "--lake", str(again.root)]
    assert main([*call, "--vehicle", "a", "--day", DAYS[0]]) == 0
    before = list(frames_of(Lake.at(lake), Partition("a", DAYS[0])))
    after = list(frames_of(again, Partition("a", DAYS[0])))
    assert len(after) == len(before) == 4
    for was, found in zip(before, after, strict=True):
        np.testing.assert_array_equal(found.lidar_xyz_m, was.lidar_xyz_m)
        np.testing.assert_array_equal(found.lidar_intensity, was.lidar_intensity)
        np.testing.assert_array_equal(found.radar_xyz_m, was.radar_xyz_m)
        np.testing.assert_allclose(found.radar_range_rate_mps, was.radar_range_rate_mps, atol=1e-5)
        for pair in ("camera_lidar", "lidar_radar"):
            np.testing.assert_allclose(found.priors[pair], was.priors[pair], atol=1e-9)
        pictures = [cv2.imdecode(np.frombuffer(f.image, np.uint8), cv2.IMREAD_COLOR) for f in (was, found)]
        np.testing.assert_array_equal(*pictures)


def killed_export(lake, out, form, at, function="os.fsync", of=None):
    """Begin an export in a process that is killed, as by `kill -9`, in its n-th call of what writes a file."""
    module, _, name = function.rpartition(".")
    code = (
        f"import os, signal, sys, {module}\nwrite, seen = {function}, []\n"
        "def dies(*given):\n    seen.append(1)\n"
        f"    return os.kill(os.getpid(), signal.SIGKILL) if len(seen) == {at} else write(*given)\n"
        f"{module}.{name} = dies\nfrom jobs.cli import main\nmain(sys.argv[1:])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *command(lake, out, form, of=of)], capture_output=True, check=False
    )
    assert done.returncode == -9


@pytest.mark.parametrize("form", ["parquet", pytest.param("nuscenes", marks=pytest.mark.slow)])
def test_an_export_killed_in_the_middle_of_a_file_goes_on_to_the_same_bytes(
    lake, tmp_path, monkeypatch, form
):
    flushes, flush = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: flushes.append(1) or flush(handle))
    export(lake, tmp_path / "whole", form)
    monkeypatch.undo()
    wanted = contents(tmp_path / "whole")
    assert not [name for name in wanted if "begun" in name]
    # Odd calls flush a file, even ones its folder.
    killed_export(lake, tmp_path / "out", form, len(flushes) // 2 | 1)
    assert list((tmp_path / "out").rglob("*.tmp"))
    whole = {p: p.stat().st_mtime_ns for p in (tmp_path / "out").rglob("done.json")}
    assert 0 < len(whole) < 6
    export(lake, tmp_path / "out", form)
    assert contents(tmp_path / "out") == wanted
    assert {p: p.stat().st_mtime_ns for p in whole} == whole  # what was whole was not made again


@pytest.mark.parametrize("later", [6, 3])
def test_files_of_a_killed_export_do_not_stay_when_its_days_are_planned_anew(tmp_path, later):
    own = tmp_path / "lake"
    own.mkdir()
    (own / "fleet.toml").write_text(fleet_toml("a", sections=ONE_SPLIT))
    training_lakes.fill(Lake.at(own), "a", DAYS[0], frames=4, **EGO)
    killed_export(own, tmp_path / "out", "nuscenes", 34)
    before = {p for p in contents(tmp_path / "out") if p.startswith("samples")}
    training_lakes.fill(Lake.at(own), "a", DAYS[0], frames=later, seed=3, **EGO)
    export(own, tmp_path / "out", "nuscenes")
    export(own, tmp_path / "fresh", "nuscenes")
    count = [len([p for p in contents(tmp_path / o) if p.startswith("samples")]) for o in ("out", "fresh")]
    assert len(before) > 8
    assert count[0] == count[1]


def test_vehicles_whose_names_differ_in_a_dot_do_not_share_a_file(tmp_path):
    names = ("a.b", "a-b", "a%2Eb")
    (tmp_path / "fleet.toml").write_text(fleet_toml(*names, sections=ONE_SPLIT))
    for name in names:
        training_lakes.fill(Lake.at(tmp_path), name, DAYS[0], frames=3, **EGO)
    card = export(tmp_path, tmp_path / "out", "parquet")
    assert len(set(card["files"]["train"])) == 3
    found = {(frame["vehicle"], frame["key"]) for frame in Frames(str(tmp_path / "out"), "train")}
    assert {v for v, _ in found} == set(names)
    assert len(found) == 9


def test_a_later_vehicle_takes_no_frame_from_a_split_that_has_it(lake, tmp_path, capsys):
    few = tmp_path / "few.toml"
    few.write_text(fleet_toml(*VEHICLES, sections=SECTION))
    out = tmp_path / "out"
    export(lake, out, "parquet", "--to", DAYS[0], fleet=few)
    first = json.loads((out / "plan.json").read_text())["sides"]
    export(lake, out, "parquet", fleet=few)
    assert json.loads((out / "plan.json").read_text())["sides"] == first
    export(lake, out, "parquet", "--seed", "4", fleet=few, code=2)  # another export has another place
    few.write_text(fleet_toml(*VEHICLES, sections=f"{SECTION}\nplace_m = 50"))  # same names of other cells
    export(lake, out, "parquet", fleet=few, code=2)
    assert "another [prepare.split] place_m" in capsys.readouterr().out


def test_moved_poses_are_exactly_as_far_off_as_is_said_and_the_answer_stands_beside_them(lake, tmp_path):
    export(lake, tmp_path / "true", "parquet")
    export(lake, tmp_path / "out", "parquet", "--perturb", "3", "0.2", "--seed", "5")
    true = {f["key"]: f for f in Frames(str(tmp_path / "true"), "train")}
    draws = []
    for frame in Frames(str(tmp_path / "out"), "train"):
        for name, own in frame["sensors"].items():
            T, answer = (np.array(own[k]) for k in ("T_reference_sensor", "answer_T_reference_sensor"))
            np.testing.assert_array_equal(answer, true[frame["key"]]["sensors"][name]["T_reference_sensor"])
            turn = np.degrees(np.linalg.norm(log_so3(T[:3, :3] @ answer[:3, :3].T)))
            wanted = (0.0, 0.0) if name == frame["reference"] else (3.0, 0.2)
            np.testing.assert_allclose((turn, np.linalg.norm(T[:3, 3] - answer[:3, 3])), wanted, atol=1e-9)
        draws.append(frame["sensors"]["camera"]["T_reference_sensor"])
    assert len({str(draw) for draw in draws}) == len(draws)


def states(lake, moved_on=None):
    """A state of vehicle a, 1 deg beside the prior of its frames; of the radar since a day."""
    priors = next(frames_of(Lake.at(lake), Partition("a", DAYS[0]))).priors
    rows = []
    for pair, since in (("camera_lidar", None), ("lidar_radar", moved_on)):
        T = exp_se3(np.array([0, 0, np.radians(1.0), 0, 0, 0])) @ priors[pair]
        q, (parent, child) = to_quaternion(T), pair.split("_")
        rows.append(StateRow(
            vehicle="a", day=DAYS[1], method="joint", pair=pair, parent_frame=parent, child_frame=child,
            status="current", reason="", since=since, work_key=str(moved_on), observable=[True] * 5 + [False],
            covariance=np.diag([1e-6] * 3 + [1e-4] * 3), common_covariance=np.zeros((6, 6)),
            determined=["azimuth", "elevation"], days=[DAYS[1]],
            **dict(zip(("qw", "qx", "qy", "qz"), q, strict=True)),
            **dict(zip(("tx_m", "ty_m", "tz_m"), T[:3, 3], strict=True)),
        ))  # fmt: skip
    commit_records(Lake.at(lake), STATES, rows)
    return priors


def test_tonight_s_state_goes_out_with_its_sigmas_and_not_with_days_before_a_sensor_moved(tmp_path):
    for day in DAYS:
        training_lakes.fill(Lake.at(tmp_path), "a", day, frames=4, **EGO)
    (tmp_path / "fleet.toml").write_text(fleet_toml("a", sections=ONE_SPLIT))
    priors = states(tmp_path)
    card = export(tmp_path, tmp_path / "out", "parquet", "--calibration", "state")
    assert card["frames"]["train"] == 8
    frame = Frames(str(tmp_path / "out"), "train")[0]
    radar = frame["sensors"]["radar"]
    turn = log_so3(np.array(radar["T_reference_sensor"])[:3, :3] @ priors["lidar_radar"][:3, :3].T)
    np.testing.assert_allclose(np.degrees(turn), [0, 0, 1], atol=1e-6)
    assert radar["status"] == "current"
    assert radar["kept_at_prior"]
    np.testing.assert_allclose(radar["sigma_rotation_deg"], np.degrees([1e-3] * 3), rtol=1e-6)
    states(tmp_path, moved_on=DAYS[1])
    card = export(tmp_path, tmp_path / "later", "parquet", "--calibration", "state", code=3)
    card = json.loads((tmp_path / "later" / "card.json").read_text())
    assert card["frames"]["train"] == 4
    [left] = card["vehicle_days_left_out"]
    assert left["day"] == DAYS[0]
    assert f"counts since {DAYS[1]}" in left["reason"]
    commit_records(Lake.at(tmp_path), STATES, [replace(r, status="none", reason="no day", **NO_POSE, work_key="n")
                                               for r in read_records(Lake.at(tmp_path), STATES, StateRow)
                                               if r.pair == "camera_lidar" and r.since is None][-1:])  # fmt: skip
    export(tmp_path, tmp_path / "without", "parquet", "--calibration", "state", code=3)
    assert (
        "pose of camera_lidar: none: no day (1 vehicle-days"
        in (tmp_path / "without" / "README.md").read_text()
    )
    assert Frames(str(tmp_path / "without"), "train")[0]["sensors"].keys() == {"lidar", "radar"}
    states(tmp_path, moved_on=DAYS[1])
    # The same place again: that day's calibration changed, so its frames are made anew, and the other goes.
    export(tmp_path, tmp_path / "out", "parquet", "--calibration", "state", code=3)
    again = json.loads((tmp_path / "out" / "card.json").read_text())
    assert again["files"] == card["files"]
    assert again["frames"] == card["frames"]


def test_an_undistorted_image_shows_a_ray_where_a_pinhole_does_and_boxes_and_labels_go_with_it(lake):
    frame = next(iter(lake_frames(lake).values()))
    bent = replace(frame, camera_D=np.array([-0.25, 0.05, 0.001, -0.001, 0.0]))
    found = undistortion_of(bent, "camera")
    camera, K = found.camera, frame.camera_K
    ray = np.array([[0.3, -0.1, 1.0]])
    there, _ = camera.project(ray)
    u, v = (K @ ray[0])[:2]
    picture = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
    cv2.circle(picture, tuple(round(c) for c in there[0]), 5, (255, 255, 255), -1)
    shown = found.pixels(cv2.imencode(".png", picture)[1].tobytes())
    rows, columns = np.nonzero(shown[..., 0] > 128)
    np.testing.assert_allclose((columns.mean(), rows.mean()), (u, v), atol=1.0)
    assert np.hypot(there[0, 0] - u, there[0, 1] - v) > 3  # else nothing was shown


def test_a_camera_that_a_plane_cannot_show_is_refused_in_a_sentence(lake, tmp_path, capsys):
    wide = Lake.at(tmp_path / "wide")
    frame = next(iter(lake_frames(lake).values()))
    width, height = frame.image_width_px, frame.image_height_px
    focal = width / 2 / np.radians(95)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    eye = {"camera_model": "equidistant", "camera_K": K, "camera_D": np.zeros(4)}
    training_lakes.fill(wide, "a", DAYS[0], frames=3, **EGO, **eye)
    (tmp_path / "wide" / "fleet.toml").write_text(fleet_toml("a", sections=ONE_SPLIT))
    export(tmp_path / "wide", tmp_path / "nuscenes", "nuscenes", code=1)
    assert "sees 190 deg, and an undistorted image can show 170 at most" in capsys.readouterr().out
    assert not list((tmp_path / "nuscenes" / "samples").rglob("*.jpg"))
    assert export(tmp_path / "wide", tmp_path / "shards", "parquet")["frames"]["train"] == 3


def test_an_empty_split_is_an_error_before_anything_is_written(lake, tmp_path, capsys):
    export(lake, tmp_path / "out", "parquet", "--vehicles", "a", code=2)
    assert "no frames for val, test" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_from_a_bucket_to_a_bucket_the_same_bytes_as_between_folders(lake, tmp_path, monkeypatch):
    export(lake, tmp_path / "out", "parquet")
    with running() as s3:
        for name, value in s3.environment.items():
            monkeypatch.setenv(name, value)
        pipeline.store.object_store._client.cache_clear()
        remote, to = Lake.at(f"s3://{BUCKET}/lake"), Lake.at(f"s3://{BUCKET}/out")
        for path, data in contents(lake).items():
            with remote.files.replacing(remote.root / path) as stream:
                stream.write(data)
        killed_export(lake, to, "parquet", 9, "obstore.put", of=remote)
        assert 0 < len([p for p in to.files.find(to.root, "**/*") if p.name == "done.json"]) < 6
        assert main(command(lake, to, "parquet", of=remote)) == 0
        found = {}
        for path in to.files.find(to.root, "**/*"):
            with to.files.opened(path) as stream:
                found[str(path.relative_to(to.root))] = stream.read()
    pipeline.store.object_store._client.cache_clear()
    assert found == contents(tmp_path / "out")


@pytest.mark.slow
def test_nuscenes_devkit_opens_what_is_written(lake, tmp_path):
    python = os.environ.get("BORESIGHT_READERS")
    if not python:
        pytest.skip("BORESIGHT_READERS names no Python with the devkit: make readers")
    export(lake, tmp_path, "nuscenes")
    call = [python, str(Path(__file__).parent / "real_loaders.py"), str(tmp_path)]
    found = json.loads(
        subprocess.run(call, capture_output=True, text=True, check=True).stdout.splitlines()[-1]
    )
    first = lake_frames(lake)["a", DAYS[0], 0]
    assert found["samples"] == 24
    assert found["lidar"] == len(first.lidar_x_m)
    assert found["radar"] == len(first.radar_x_m)
    assert found["in_image"] > 100
    assert all(found["scenes"].values())

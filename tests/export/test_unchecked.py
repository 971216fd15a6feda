"""Axes that lie far from the prior and that nothing checks: states carry them, exports leave them at the prior."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jobs.cli import main
from pipeline.config import FleetConfig
from pipeline.export.calibration import ExportedPair
from pipeline.geometry.changes import change_between, change_covariance
from pipeline.geometry.pose_columns import pose_columns
from pipeline.geometry.se3 import exp_se3, inverse
from pipeline.stage_work import Task, Window
from pipeline.stages import AUDIT, STATE
from pipeline.store.commits import commit_records
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.poses import POSES, PoseRow
from tests.audit.fleet_records import T_LIDAR_RADAR, vehicle_records
from tests.makers.calibrations import T_CAMERA_LIDAR
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.lakes import write_frames

FRAME_IDS = {"camera": ["front_optical"], "lidar": ["/top"], "radar": ["radar_front"]}
ROLLED = {"radar": np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])}  # [rad]


def _fleet() -> FleetConfig:
    fleet = {"fleet": {"name": "test"}, "rigs": {"default": THREE_SENSORS}, "vehicles": {"v": {}}}
    return FleetConfig.model_validate(fleet)


@pytest.fixture(scope="module")
def lake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six days of a radar that is rolled by 0.05 rad, which four of them call unchecked."""
    folder = tmp_path_factory.mktemp("unchecked")
    rows = []
    for k, r in enumerate(vehicle_records("v", 6, np.random.default_rng(1), motion=lambda _: ROLLED)):
        far = {"unchecked_rx_sigmas": 3.0 + 0.01 * k} if r.pair == "lidar_radar" and k < 12 else {}
        certified = ["azimuth"] if r.pair != "camera_lidar" else ["azimuth", "elevation"]
        rows.append(replace(r, determined=certified, diagnostics=far))
    tables = Lake.at(folder)
    commit_records(tables, CALIBRATIONS, rows)
    task = Task(_fleet(), tables, Window())
    AUDIT.run(task)
    STATE.run(task)
    write_frames(tables, Partition("v", "2026-03-06"), [], frame_ids=FRAME_IDS)
    return folder


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(a) for a in arguments])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_a_state_carries_what_most_of_its_days_call_unchecked(
    lake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, out, _ = run(capsys, "state", "--lake", lake, "--json")
    states = {s["pair"]: s for s in json.loads(out)}
    assert states["lidar_radar"]["unchecked"] == {"rx": pytest.approx(3.11)}
    assert states["camera_lidar"]["unchecked"] == {}
    np.testing.assert_allclose(states["lidar_radar"]["T_prior"], T_LIDAR_RADAR, atol=1e-9)
    _, out, _ = run(capsys, "state", "--lake", lake)
    words = " ".join(out.split())
    assert "sigma from the prior" in words
    assert f"{states['lidar_radar']['T'][0][3]:.3f}" in words
    assert "deg" in words


@pytest.fixture(scope="module")
def adjusted(lake: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same lake with a pose of each sensor beside the records of its pairs."""
    folder = tmp_path_factory.mktemp("adjusted") / "lake"
    shutil.copytree(lake, folder)
    tables = Lake.at(folder)
    rows = []
    for record in read_records(tables, CALIBRATIONS, CalibrationRecord):
        T = transform_of(record)
        if T is None or record.pair == "camera_radar":
            continue
        sensor = "camera" if record.pair == "camera_lidar" else "radar"
        pose = inverse(T) if sensor == "camera" else T
        shared = {
            n: getattr(record, n)
            for n in ("vehicle", "day", "method", "work_key", "determined", "observable")
        }
        shared |= {"reference": "lidar", "status": "accepted", "reason": "", "code_version": "0.11.0"}
        kept = {"covariance": record.covariance, "common_covariance": 0.1 * record.covariance}
        rows.append(PoseRow(sensor=sensor, kind=sensor, **shared, **kept, **pose_columns(pose)))
        if sensor == "camera":
            at = {"covariance": np.zeros((6, 6)), **pose_columns(np.eye(4))}
            rows.append(PoseRow(sensor="lidar", kind="lidar", **shared, **at))
    commit_records(tables, POSES, rows)
    STATE.run(Task(_fleet(), tables, Window()))
    return folder


@pytest.mark.parametrize("source", [[], ["--day", "2026-03-04"]])
def test_poses_of_one_of_each_are_written_with_what_their_pairs_call_unchecked(
    adjusted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], source: list[str]
) -> None:
    out = tmp_path / "car.urdf"
    _, said, err = run(capsys, "export", "urdf", "--lake", adjusted, "--vehicle", "v", *source, "--out", out)
    side = json.loads(out.with_suffix(".provenance.json").read_text())
    assert set(side["pairs"]) == {"camera_lidar", "camera_radar", "lidar_radar"}
    assert json.loads(said.splitlines()[-1])["pairs"] == ["camera_lidar", "lidar_radar"]
    T = np.array(side["pairs"]["lidar_radar"]["T_lidar_radar"])
    assert change_between(T_LIDAR_RADAR, T)[0] == pytest.approx(0.0, abs=1e-9)
    assert "sigma from the prior and no check covers it" in err


@pytest.mark.parametrize("source", [[], ["--day", "2026-03-04"]])
def test_an_export_leaves_it_at_the_prior_unless_it_is_asked_for(
    lake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], source: list[str]
) -> None:
    call = ["export", "urdf", "--lake", lake, "--vehicle", "v", *source]
    rolls = {}
    for options in ([], ["--unchecked"]):
        out = tmp_path / f"{len(options)}.urdf"
        code, said, err = run(capsys, *call, *options, "--out", out)
        assert out.is_file(), said + err
        side = json.loads(out.with_suffix(".provenance.json").read_text())
        pair = side["pairs"]["lidar_radar"]
        rolls[len(options)] = change_between(T_LIDAR_RADAR, np.array(pair["T_lidar_radar"]))[0]
        assert code == 3
        assert "rx" in pair["unchecked_sigmas"]
        assert ("rx" in pair["kept_at_prior"]) == (not options)
        assert "sigma from the prior and no check covers it" in err
        assert any("no check covers it" in words for words in side["warnings"])
    assert rolls[0] == pytest.approx(0.0, abs=1e-9)
    assert rolls[1] == pytest.approx(0.05, abs=0.02)


def test_frames_are_called_as_the_logs_call_them_and_come_back_without_being_named(
    lake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = ["export", "urdf", "--lake", lake, "--vehicle", "v"]
    for options, names in (
        ([], ("front_optical", "top", "radar_front")),
        (["--generic-frames"], ("camera", "lidar", "radar")),
        (["--radar-frame", "bumper"], ("front_optical", "top", "bumper")),
    ):
        out = tmp_path / f"{names[2]}.urdf"
        run(capsys, *call, *options, "--out", out)
        assert all(f'link name="{name}"' in out.read_text() for name in names)
        assert run(capsys, "import", "urdf", out, "--out", tmp_path / "prior.json")[0] == 0
    run(capsys, "export", "autoware", "--lake", lake, "--vehicle", "v", "--out", tmp_path / "kit")
    assert "front_optical" not in (tmp_path / "kit" / "sensor_kit_calibration.yaml").read_text()


def test_what_rests_at_the_prior_is_as_unsure_as_it_and_the_others_follow_as_they_covary() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6)) * np.array([[1e-3] * 3 + [1e-2] * 3]).T
    prior = np.diag([0.03] * 3 + [0.05] * 3) ** 2
    xi = np.array([0.02, 0.001, -0.002, 0.01, 0.02, -0.01])
    pair = ExportedPair(
        "camera_lidar", exp_se3(xi) @ T_CAMERA_LIDAR, root @ root.T, unchecked={"rx": 4.0, "tz": 3.2}
    )
    found = pair.resting_at(T_CAMERA_LIDAR, prior)
    change = change_between(T_CAMERA_LIDAR, found.T)
    np.testing.assert_allclose(change[[0, 5]], 0.0, atol=1e-9)
    assert found.covariance is not None
    C = change_covariance(found.T, found.covariance)
    np.testing.assert_allclose(C[np.ix_([0, 5], [0, 5])], np.asarray(
        change_covariance(T_CAMERA_LIDAR, prior))[np.ix_([0, 5], [0, 5])], rtol=1e-6)  # fmt: skip
    assert np.linalg.eigvalsh(C).min() > 0
    # What the day knows whatever the two are, it knows as before: combinations that do not covary with them.
    before = change_covariance(pair.T, pair.covariance)
    known = np.linalg.inv(before)[[1, 2, 3, 4]]  # rows of the information orthogonal to rx and tz's marginal
    step = change_between(T_CAMERA_LIDAR, pair.T) - change
    np.testing.assert_allclose(known @ step, 0.0, atol=1e-6 * np.abs(known).max())

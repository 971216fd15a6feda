"""`boresight verify` on a simulated log: the true calibration passes, a wrong one fails, nonsense is refused."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from jobs.calibration_sources import FrameOptions, poses_in_use
from jobs.verify import with_calibration
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.rig.day_prior import read_star
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from schemas.poses import POSES
from tests.export.test_import_rig import FLEET, OTHERS, T_TOP, exported
from tests.makers.commands import command
from tests.makers.fleet_files import fleet_toml
from tests.makers.rig_records import pose_rows, rig_records
from tests.makers.simulated_days import simulated_day

FRAMES = 30


@pytest.fixture(scope="module")
def car(tmp_path_factory):
    """One log of a car, its fleet.toml and its true calibration."""
    folder = tmp_path_factory.mktemp("car")
    made = simulated_day(folder, frames=FRAMES, seed=23)
    return made.fleet_file, sorted((folder / "logs").rglob("*.mcap")), made.truth


def calibration(path, truth, turned_deg=0.0):
    turn = from_rotation_translation(exp_so3(np.radians([0.0, turned_deg, 0.0])), np.zeros(3))
    T = {"T_camera_lidar": turn @ truth["camera_lidar"], "T_lidar_radar": truth["lidar_radar"]}
    path.write_text(json.dumps({name: matrix.tolist() for name, matrix in T.items()}))
    return path


def verify(car, file, capsys, *more):
    fleet, logs, _ = car
    options = ["--fleet", fleet, "--calibration", file, "--json", *more]
    return command(capsys, "verify", *logs, *options)[:2]


def status_of(answer, pair, axis):
    (found,) = [a for a in answer["axes"] if (a["pair"], a["axis"]) == (pair, axis)]
    return found["status"]


@pytest.mark.slow
def test_a_right_calibration_passes_and_a_camera_turned_by_half_a_degree_fails(car, tmp_path, capsys):
    page = tmp_path / "page.html"
    code, answer = verify(car, calibration(tmp_path / "true.json", car[2]), capsys, "--page", str(page))
    assert (code, answer["answer"]) == (0, "right")
    assert status_of(answer, "camera_lidar", "azimuth") in {"pass", "warn"}
    assert 'class="answer good"' in page.read_text()
    assert page.read_text().count("data:image/jpeg") >= 3  # overlays of both calibrations

    code, answer = verify(car, calibration(tmp_path / "off.json", car[2], turned_deg=0.5), capsys)
    assert (code, answer["answer"], answer["wrong_sensors"]) == (4, "wrong", ["camera"])
    assert status_of(answer, "camera_lidar", "azimuth") == "fail"
    assert status_of(answer, "lidar_radar", "azimuth") in {"pass", "warn"}


@pytest.mark.slow
def test_a_log_with_a_few_frames_is_inconclusive_with_the_reason(car, tmp_path, capsys):
    file = calibration(tmp_path / "true.json", car[2])
    code, answer = verify(car, file, capsys, "--frames", "3")
    assert (code, answer["answer"]) == (5, "inconclusive")
    assert {a["status"] for a in answer["axes"]} == {"inconclusive"}
    assert "frames" in answer["reason"]


def test_a_calibration_in_the_format_of_another_program_becomes_the_prior(tmp_path):
    T = {"camera_lidar": np.eye(4), "lidar_radar": np.eye(4)}
    T["camera_lidar"][:3] = from_rotation_translation(exp_so3(np.array([0.1, -0.2, 0.3])), np.arange(3.0))[:3]
    file = tmp_path / "in_use.yaml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for pair, matrix in T.items():
        storage.write(f"T_{pair}", matrix)
    storage.release()
    (tmp_path / "fleet.toml").write_text(fleet_toml("car"))
    given = (load_fleet(tmp_path / "fleet.toml"), "car", f"opencv:{file}", None, FrameOptions())
    config, lacking = with_calibration(tmp_path / "prior.json", *given)
    assert lacking == []
    rig = config.rig_of("car")
    prior = read_star(tmp_path / "prior.json", rig)
    assert rig.prior.file == str(tmp_path / "prior.json")
    np.testing.assert_allclose(inverse(prior["lidar", "camera"]), T["camera_lidar"], atol=1e-12)
    np.testing.assert_allclose(prior["lidar", "radar"], T["lidar_radar"], atol=1e-12)


def test_nonsense_is_refused_before_a_log_is_opened(tmp_path, capsys):
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(fleet_toml("car"))
    (tmp_path / "empty.json").write_text("{}")
    calls = {
        "T_camera_lidar": ["no.mcap", "--calibration", str(tmp_path / "empty.json")],
        "needs --lake": ["no.mcap", "--calibration", "2026-03-02"],
        "unknown vehicle": ["no.mcap", "--vehicle", "nobody"],
        "name at least one log": [],
    }
    for said, arguments in calls.items():
        told = command(capsys, "verify", *arguments, "--fleet", fleet)
        assert (told.code, said in told.out) == (2, True)


# A rig of many sensors.


@pytest.fixture
def van(tmp_path):
    (tmp_path / "fleet.toml").write_text(FLEET)
    return load_fleet(tmp_path / "fleet.toml")


def in_use(van, folder, text, lake=None):
    return with_calibration(folder / "written.json", van, "van-1", text, lake, FrameOptions())


@pytest.mark.parametrize("form", ["urdf", "autoware", "kalibr"])
def test_it_takes_what_export_writes_and_goes_on_without_sensors_that_the_files_lack(form, van, tmp_path):
    files = [
        f for f in exported(tmp_path, form, [s for s in OTHERS if s.name != "left"]) if "provenance" not in f
    ]
    text = f"{form}:{','.join(f for f in files if not f.endswith('.xacro'))}"
    config, lacking = in_use(van, tmp_path, text)
    assert [s.name for s in lacking] == ["left"]
    rig = config.rig_of("van-1")
    assert rig.sensors == ("front", "side", "top", "bumper", "corner")
    assert van.rig_of("van-1").sensors != rig.sensors  # what was given stays
    star = read_star(Path(rig.prior.file), rig)
    for name in ("front", "side", "bumper", "corner"):
        np.testing.assert_allclose(star["top", name], T_TOP[name], atol=1e-9)


def test_a_prior_file_is_taken_as_it_is(van, tmp_path):
    file = tmp_path / "in_use.json"
    file.write_text(json.dumps({"reference": "top", "T": {n: T.tolist() for n, T in T_TOP.items()}}))
    config, lacking = in_use(van, tmp_path, str(file))
    assert (config.rig_of("van-1").prior.file, lacking) == (str(file), [])


def test_a_day_of_a_lake_is_taken_by_its_poses(van, tmp_path):
    lake = Lake.at(tmp_path / "lake")
    commit_records(lake, CALIBRATIONS, rig_records("van-1", 1, np.random.default_rng(2)))
    commit_records(lake, POSES, pose_rows("van-1", 1, np.random.default_rng(3)))
    config, lacking = in_use(van, tmp_path, "2026-03-01", str(lake.root))
    assert [s.name for s in lacking] == ["side"]
    assert len(read_star(Path(config.rig_of("van-1").prior.file), config.rig_of("van-1"))) == 4


def test_what_is_no_calibration_is_refused_in_words(van, tmp_path):
    with pytest.raises(ConfigError, match="is neither FORMAT:FILE nor"):
        in_use(van, tmp_path, "car.urdf")
    files = exported(tmp_path, "urdf", OTHERS[:1])
    (tmp_path / "urdf" / "sensors.urdf").write_text('<robot name="r"><link name="a"/></robot>')
    with pytest.raises(ConfigError, match="no chain joins these frames"):
        poses_in_use(f"urdf:{files[0]}", None, "van-1", van.rig_of("van-1"), FrameOptions())

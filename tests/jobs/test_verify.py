"""`boresight verify` on a simulated log: the true calibration passes, a wrong one fails, nonsense is refused."""

import json

import cv2
import numpy as np
import pytest

from jobs.calibration_sources import FrameOptions
from jobs.cli import main
from jobs.verify import with_calibration
from pipeline.core.config import load_fleet
from pipeline.rig.day_prior import read_star
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse
from tests.makers.fleet_files import fleet_toml
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
    options = ["--fleet", str(fleet), "--calibration", str(file), "--json", *more]
    code = main(["verify", *map(str, logs), *options])
    return code, json.loads(capsys.readouterr().out)


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
        assert main(["verify", *arguments, "--fleet", str(fleet)]) == 2
        assert said in capsys.readouterr().out

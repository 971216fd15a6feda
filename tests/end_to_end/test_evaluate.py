"""The command evaluate on real files: the picks as the simulator wrote them, the recording, an error of known size."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline.rig.graph import pose_columns
from pipeline.rig.se3 import exp_so3
from pipeline.simulate.fleet import FleetSpec
from pipeline.simulate.reflectors import simulate_reflectors
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS, FRAMES_OF_PAIR, PAIRS, CalibrationRecord
from tests.makers.commands import boresight
from tests.makers.kept_days import kept_fleet
from tests.makers.lakes import write_records

pytestmark = pytest.mark.slow
VEHICLE, DAY = "vehicle-1", "2026-03-02"
YAW_DEG = 0.6  # put into camera-lidar, and into nothing else


def record(pair, T, environment="urban", day=DAY):
    parent, child = FRAMES_OF_PAIR[pair]
    return CalibrationRecord(
        vehicle=VEHICLE, day=day, method="joint-optimisation", pair=pair, parent_frame=parent, child_frame=child,
        status="accepted", reason="", work_key="key", code_version="0", seed=0, environment=environment,
        **pose_columns(T), **pose_columns(T, "prior_"),
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A day's logs, its reflector recording ingested into a lake of its own, and records with one known error."""
    out = tmp_path_factory.mktemp("evaluate")
    spec = FleetSpec(vehicles=1, days=1, first_day=DAY, frames=3, drives=1)
    kept_fleet(spec, out)
    simulate_reflectors(spec, 0, 0, out, frames=20)
    code, summary, _, stderr = boresight(
        "ingest", out / f"reflectors/{VEHICLE}/{DAY}.mcap", "--fleet", out / "fleet.toml",
        "--lake", out / "standing", "--vehicle", VEHICLE, "--day", DAY,
    )  # fmt: skip
    assert (code, summary["rows"] >= 15) == (0, True), stderr
    truth = json.loads((out / f"truth/{VEHICLE}/{DAY}.json").read_text())
    T = {pair: np.array(truth[f"T_{pair}"]) for pair in ("camera_lidar", "lidar_radar")}
    T["camera_radar"] = T["camera_lidar"] @ T["lidar_radar"]
    turn = np.eye(4)
    turn[:3, :3] = exp_so3(np.array([0.0, 0.0, np.radians(YAW_DEG)]))
    T["camera_lidar"] = T["camera_lidar"] @ turn
    for day in (DAY, "2026-03-09"):  # nobody recorded reflectors on the second one
        rows = [record(pair, T[pair], day=day) for pair in PAIRS]
        write_records(Lake.at(out / "lake"), CALIBRATIONS, rows, "key")
    return out


def row(path, method="joint-optimisation", environment="all"):
    rows = pq.read_table(path).to_pylist()
    return next(r for r in rows if (r["method"], r["environment"]) == (method, environment))


def check_errors(path):
    """The yaw shows in camera-lidar and in the loop; elsewhere there is only what the truth itself is worth."""
    found, sigma = row(path), row(path, "(truth: 1 sigma of the positions)")
    focal = 0.03  # [deg] the simulated camera's true focal length and centre are not the nominal ones
    for name in ("camera_lidar_azimuth_deg", "loop_azimuth_deg"):
        assert found[name] == pytest.approx(YAW_DEG, abs=4 * sigma[name] + 2 * focal)
    for name in ("camera_lidar_elevation_deg", "camera_radar_azimuth_deg", "lidar_radar_azimuth_deg"):
        assert found[name] < 4 * sigma[name] + 2 * focal
    # The radar's own biases: range to 0.15 m, elevation to a tenth of its resolution of 6 deg.
    assert found["lidar_radar_range_m"] < 0.2
    assert found["lidar_radar_elevation_deg"] < 0.6
    assert found["loop_elevation_deg"] < 0.05
    assert found["loop_range_m"] < 0.01
    return sigma


def test_the_picks_that_simulate_wrote_are_read_as_they_are(folder):
    out = folder / "picked"
    code, summary, _, stderr = boresight(
        "evaluate", "--lake", folder / "lake", "--reflectors", folder / "reflectors", "--out", out
    )
    assert (code, summary["runs"], summary["runs_without_truth"]) == (0, 1, 1)
    sigma = check_errors(out / "table_1.parquet")
    assert 0 < sigma["camera_lidar_azimuth_deg"] < 0.15
    first, extended = (out / f"{name}.md" for name in ("table_1", "extended_table_1"))
    assert "- radar: picked, mean of 20 / 20 / " in first.read_text()
    assert "- lidar: picked, once" in first.read_text()
    assert "| joint-optimisation | urban | 1 | 0." in extended.read_text()
    assert "| joint-ssl | highway | 0 | - | - | - | - |  |" in extended.read_text()
    assert "Extended data table 1" in stderr
    page = (out / "table_1.html").read_text()
    for words in (
        "paper: joint SSL",
        "Extended data table 1",
        "Every run",
        "No pictures: the lake no longer has",
    ):
        assert words in page
    assert "Are the sigmas right?" not in page  # positions are no truth for each axis
    one_file = folder / "one.md"
    path = folder / f"reflectors/{VEHICLE}/{DAY}.json"
    assert boresight("evaluate", "--lake", folder / "lake", "--reflectors", path, "--out", one_file)[0] == 0
    assert one_file.read_text() == first.read_text() + "\n" + extended.read_text()


def test_lidar_and_radar_positions_are_found_in_the_recording_near_rough_guesses(folder):
    content = json.loads((folder / f"reflectors/{VEHICLE}/{DAY}.json").read_text())
    rng = np.random.default_rng(6)
    for target in content["targets"]:
        for key in ("lidar_m", "radar_m"):
            target[key] = (np.array(target[key]) + rng.uniform(-0.3, 0.3, 3)).tolist()
    rough, out = folder / "rough.json", folder / "found.parquet"
    rough.write_text(json.dumps(content))
    code, summary, *_ = boresight(
        "evaluate", "--lake", folder / "lake", "--reflectors", rough,
        "--recording-lake", folder / "standing", "--out", out,
    )  # fmt: skip
    assert (code, summary["runs"]) == (0, 1)
    pixels, lidar, radar, _ = summary["positions"]
    assert pixels == "camera pixels: picked, once"
    assert lidar.startswith(
        f"lidar: apex of a 0.35 m trihedral found in standing {VEHICLE} {DAY}, reflectors 1 ("
    )
    assert radar.startswith(f"radar: strongest echo found in standing {VEHICLE} {DAY}, reflectors 1 (")
    sigma = check_errors(out)
    spread = row(out, "(truth: spread of one frame's pick)")
    assert spread["lidar_radar_elevation_deg"] > 2 * sigma["lidar_radar_elevation_deg"]


def test_a_recording_in_which_the_car_drives_is_refused(folder):
    code, _, _, stderr = boresight(
        "ingest", *(folder / f"logs/{VEHICLE}/{DAY}").iterdir(), "--fleet", folder / "fleet.toml",
        "--lake", folder / "lake", "--vehicle", VEHICLE, "--day", DAY,
    )  # fmt: skip
    assert code == 0, stderr
    code, _, _, stderr = boresight(
        "evaluate", "--lake", folder / "lake", "--reflectors", folder / "reflectors", "--recording-day", DAY
    )
    assert code not in (0, 3)
    assert "no standing reflector recording" in stderr

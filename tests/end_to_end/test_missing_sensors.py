"""A night of rigs with two sensors, and of one whose radar is silent: each pair that a vehicle has is calibrated."""

import json
import re
import shutil

import numpy as np
import pytest

from jobs.cli import main
from pipeline.rig.se3 import from_quaternion, log_so3
from pipeline.simulate.fleet import FleetSpec
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.views import observations_of
from schemas.calibrations import CALIBRATIONS, PAIRS, SENSORS, CalibrationRecord
from schemas.drift import DRIFT, DriftFinding
from schemas.states import STATES, StateRow
from tests.makers.kept_days import kept_fleet

pytestmark = pytest.mark.slow  # a night of four vehicles

DAY = "2026-03-02"
GONE = {"no-camera": "camera", "no-lidar": "lidar", "no-radar": "radar"}
PAIR = {"no-camera": "lidar_radar", "no-lidar": "camera_radar", "no-radar": "camera_lidar"}
SECTION = r"\[rigs\.demo\.{}\]\n(?:.+\n)+\n?"


def fleet_text(text):
    """One rig without each sensor, and one whose radar's topic nobody logs, all of the demo rig's logs."""
    head, tail = text[: text.index("[rigs.")], text[text.index("[rigs.") : text.index("[vehicles.")]
    rigs = {name: re.sub(SECTION.format(sensor), "", tail) for name, sensor in GONE.items()}
    radar = re.search(SECTION.format("radar"), tail).group()
    rigs["silent"] = tail.replace(radar, re.sub(r'points = ".*"', 'points = "/radar/none"', radar))
    parts = [rig.replace("[rigs.demo.", f"[rigs.{name}.") for name, rig in rigs.items()]
    vehicles = [f'[vehicles."{name}"]\nrig = "{name}"\n' for name in rigs]
    return head + "\n".join([*parts, *vehicles])


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """The folder of a night's lake and pages, and the night's summary."""
    out = tmp_path_factory.mktemp("rigs")
    kept_fleet(FleetSpec(vehicles=1, days=1, first_day=DAY, frames=32, seed=21, environments="urban"), out)
    fleet = out / "fleet.toml"
    fleet.write_text(fleet_text(fleet.read_text()))
    for name in (*GONE, "silent"):
        shutil.copytree(out / "logs" / "vehicle-1", out / "logs" / name)
    shutil.rmtree(out / "logs" / "vehicle-1")
    logs = f"{out}/logs/{{vehicle}}/{{day}}/*"
    call = ["nightly", "--fleet", str(fleet), "--lake", str(out / "lake"), "--logs", logs]
    assert main([*call, "--executor", "inline", "--report", str(out / "pages" / "fleet.html")]) in (0, 3)
    return out


def records_of(night, vehicle):
    found = read_records(Lake.at(night / "lake"), CALIBRATIONS, CalibrationRecord, vehicle=vehicle)
    return {r.pair: r for r in found}


@pytest.mark.parametrize("vehicle", GONE)
def test_a_rig_of_two_sensors_has_records_of_its_one_pair(night, vehicle):
    records = records_of(night, vehicle)
    assert set(records) == {PAIR[vehicle]}
    (record,) = records.values()
    assert record.status in ("accepted", "held"), record.reason
    assert record.prior_qw is not None
    truth = json.loads((night / "truth" / "vehicle-1" / f"{DAY}.json").read_text())
    T = from_quaternion(np.array([record.qw, record.qx, record.qy, record.qz]), np.zeros(3))
    off = log_so3(T[:3, :3] @ np.array(truth[f"T_{record.pair}"])[:3, :3].T)
    sigma = np.sqrt(np.diag(record.covariance)[:3])
    assert np.all(np.abs(off) < 5 * sigma), np.degrees([off, sigma])


@pytest.mark.parametrize("vehicle", GONE)
def test_audit_state_and_observations_are_of_what_the_rig_has(night, vehicle):
    lake = Lake.at(night / "lake")
    rows = list(observations_of(lake, Partition(vehicle, DAY)))
    assert all(set(o.sensors) == set(SENSORS) - {GONE[vehicle]} for o in rows)
    drift = read_records(lake, DRIFT, DriftFinding, vehicle=vehicle)
    assert {(f.pair, f.vehicle_status) for f in drift} == {(PAIR[vehicle], "UNKNOWN")}
    states = read_records(lake, STATES, StateRow, vehicle=vehicle)
    assert {s.pair for s in states if s.sensor is None} == {PAIR[vehicle]}


def test_a_silent_radar_costs_its_own_pairs_only_and_they_say_why(night):
    records = records_of(night, "silent")
    assert set(records) == set(PAIRS)
    assert records["camera_lidar"].status in ("accepted", "held")
    assert records["camera_lidar"].reason == records_of(night, "no-radar")["camera_lidar"].reason
    for pair in ("camera_radar", "lidar_radar"):
        assert records[pair].status == "refused"
        assert records[pair].faults == ["silent_sensor"]
        assert "the radar is silent: 0 of" in records[pair].reason
        assert "/radar/none" in records[pair].reason


@pytest.mark.parametrize("method", ["tracking", "joint-optimisation"])
def test_methods_that_need_all_three_refuse_and_name_the_missing_sensor(night, method):
    about = ["--fleet", str(night / "fleet.toml"), "--lake", str(night / "lake"), "--day", DAY]
    for vehicle, words in (("no-lidar", "the rig has no lidar"), ("silent", "the radar is silent")):
        assert main(["calibrate", *about, "--vehicle", vehicle, "--method", method]) == 3
        found = read_records(Lake.at(night / "lake"), CALIBRATIONS, CalibrationRecord, vehicle=vehicle)
        own = [r for r in found if r.method == method]
        assert {r.status for r in own} == {"refused"}
        assert all(words in r.reason for r in own)


@pytest.mark.parametrize("vehicle", GONE)
def test_what_a_rig_of_two_sensors_has_goes_out(night, vehicle, tmp_path):
    about = ["--lake", str(night / "lake"), "--vehicle", vehicle]
    codes = (4,) if vehicle == "no-lidar" else (0, 3)  # 32 frames of a camera and a radar certify nothing
    assert main(["export", "ros2", "--out", str(tmp_path / "ros2"), *about]) in codes
    drive = ["export", "foxglove", "--out", str(tmp_path / "drive.mcap"), "--day", DAY, "--force"]
    assert main([*drive, *about]) in codes
    assert (tmp_path / "drive.mcap").stat().st_size > 0

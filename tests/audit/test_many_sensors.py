"""Audit and state of rigs of many sensors: charts by edge, sensors by name."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.config import load_fleet
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT, STATE
from pipeline.store.commits import commit_records
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS
from schemas.poses import POSES
from schemas.states import STATES, StateRow
from tests.makers.rig_records import EDGES, POSE_SIGMA, pose_rows, rig_records

RIGS = """
[fleet]
name = "vans"
[rigs.van.prior]
source = "tf_static"
[rigs.van.cameras.front]
image = "/front"
info = "/front_info"
[rigs.van.cameras.left]
image = "/left"
info = "/left_info"
[rigs.van.lidars.top]
points = "/top"
[rigs.van.radars.bumper]
points = "/bumper"
[rigs.van.radars.corner]
points = "/corner"
[vehicles."*"]
rig = "van"
[vehicles.new]
rig = "van"
"""
TURN = np.array([0.0, np.radians(0.5), 0.0, 0.0, 0.0, 0.0])
EDGE_NAMES = {(e.parent.name, e.child.name) for e in EDGES}


@pytest.fixture
def fleet(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text(RIGS)
    return load_fleet(path)


def audited(fleet, lake, rows):
    commit_records(lake, CALIBRATIONS, rows)
    found = AUDIT.run(Task(fleet, lake, Window())).records
    return {vehicle: [f for f in found if f.vehicle == vehicle] for vehicle in "ab"}


def edge(finding):
    return finding.parent_frame, finding.child_frame


@pytest.mark.parametrize("sensor", ["left", "corner", "top"])
def test_the_sensor_that_moved_is_named_among_five_and_its_edges_alone_alarm(fleet, lake, sensor):
    turn = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.0, 0.0]) if sensor == "corner" else TURN
    rng = np.random.default_rng(4)
    moved = rig_records("a", 12, rng, motion=lambda day: {sensor: turn} if day > 6 else {})
    found = audited(fleet, lake, moved + rig_records("b", 12, rng))
    alarms = [f for f in found["a"] if f.status == "RED"]
    assert {f.moved_sensor for f in alarms} == {f.vehicle_sensor for f in found["a"]} == {sensor}
    assert {f.vehicle_since for f in found["a"]} == {"2026-03-08"}
    assert all(sensor in edge(f) for f in alarms)
    assert {f.vehicle_status for f in found["b"]} == {"GREEN"}
    assert {edge(f) for f in found["b"]} == EDGE_NAMES


def test_a_state_s_sigmas_are_of_targets_where_the_sensors_look(fleet, lake):
    """Ahead of a radar that looks left, elevation is the lidar's roll; beside it, the pitch, known better."""
    [edge] = [e for e in EDGES if e.child.name == "corner"]
    ahead, beside = np.array([[25.0, 0, 0]] * 3), np.array([[0, 25.0, 0]] * 3)
    found = {}
    for vehicle, targets in (
        ("a", beside),
        ("b", ahead),
        ("c", None),
    ):  # of the radar, which looks to the left
        rng = np.random.default_rng(9)
        rows = rig_records(vehicle, 3, rng, edges=[edge])
        commit_records(lake, CALIBRATIONS, [replace(r, targets_m=targets) for r in rows])
        unsure = np.diag([np.radians(0.5) ** 2, *(POSE_SIGMA**2)[1:]])
        columns = {"covariance": unsure, "common_covariance": 0.1 * unsure}
        poses = [r for r in pose_rows(vehicle, 3, rng) if r.sensor in ("top", "corner")]
        commit_records(lake, POSES, [r if r.sensor == "top" else replace(r, **columns) for r in poses])
    STATE.run(Task(fleet, lake, Window()))
    states = [s for s in read_records(lake, STATES, StateRow) if s.azimuth_sigma_rad is not None]
    for of_sensor in (True, False):  # a sensor and its edge to the reference have one accuracy
        found = {
            s.vehicle: np.degrees(s.elevation_sigma_rad)
            for s in states
            if (s.sensor is not None) == of_sensor and s.child_frame == "corner"
        }
        assert found["b"] > 1.5 * found["a"]
        assert found["c"] == pytest.approx(found["b"], rel=0.1)

"""Everyday faults in logs are stopped and named, and leave what does not use the faulty sensor right."""

import json

import numpy as np
import pytest

from pipeline.core.config import load_fleet
from pipeline.rig.se3 import from_rotation_translation
from pipeline.rig.targets import errors_at_targets
from pipeline.simulate.fleet import FleetSpec
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from tests.makers import fault_logs as edits
from tests.makers.kept_days import kept_fleet
from tests.makers.simulated_days import DATE, transforms_of
from tests.makers.stages import calibrate_day, ingest_day, perceive_day

IMAGE, INFO = "/camera/front/image/compressed", "/camera/front/camera_info"
LIDAR, RADAR, ODOMETRY, TF = "/lidar/top/points", "/radar/front/points", "/vehicle/odometry", "/tf_static"
LABELS = "/perception/camera/labels"
RAISED = from_rotation_translation(np.eye(3), np.array([0, 0, 0.3]))
OF_LIDAR, OF_CAMERA, OF_RADAR = {"camera_lidar", "lidar_radar"}, {"camera_lidar"}, {"lidar_radar"}
# Of each fault: its topics, the edit, pairs that it stops, and the names that it may be given.
FAULTS = {
    "labels 3 px to the right": ([LABELS], edits.labels_right(3), OF_CAMERA, {"labels_offset"}),
    "a focal length 5 % short": ([INFO], edits.focal(-0.05), OF_CAMERA, {"camera_info"}),
    "an image that stands still": ([IMAGE, LABELS], edits.stuck, OF_CAMERA, {"stuck_sensor"}),
    "no labels": ([LABELS], edits.silent, OF_CAMERA, {"no_labels"}),
    "lidar points in millimetres": ([LIDAR], edits.points(1000 * np.eye(3)), OF_LIDAR, {"unit", "prior"}),
    "a mirrored lidar": ([LIDAR], edits.points(np.diag([1, -1, 1])), OF_LIDAR, {"orientation", "prior"}),
    "a lidar knocked at noon": ([LIDAR], edits.points(edits.turned(0.5), 0.5), OF_LIDAR, {"moved_in_day"}),
    "a lidar mounted 30 cm higher": ([TF], edits.mounted("lidar_top", RAISED), OF_LIDAR, {"prior"}),
    "a radar without points": ([RADAR], edits.empty, OF_RADAR, {"silent_sensor"}),
    "a radar that looks back": ([RADAR], edits.points(edits.turned(180)), OF_RADAR, {"orientation", "prior"}),
    "a radar knocked at noon": ([RADAR], edits.points(edits.turned(1), 0.5), OF_RADAR, {"moved_in_day"}),
    "odometry backwards": ([ODOMETRY], edits.odometry(-1), OF_LIDAR, {"odometry"}),
}  # fmt: skip


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    folder = tmp_path_factory.mktemp("day")
    kept_fleet(FleetSpec(vehicles=1, days=1, first_day=DATE, frames=60, rig="demo", seed=103), folder)
    truth = json.loads((folder / "truth" / "vehicle-1" / f"{DATE}.json").read_text())
    return folder, sorted((folder / "logs" / "vehicle-1" / DATE).iterdir()), transforms_of(truth)


def records_of(folder, logs, lake):
    fleet, partition = load_fleet(folder / "fleet.toml"), Partition("vehicle-1", DATE)
    outcome = ingest_day(logs, partition, fleet, lake)
    outcome = outcome if outcome.status == "refused" else perceive_day(partition, fleet, lake)
    calibrate_day(partition, fleet, lake, **({"given": outcome} if outcome.status == "refused" else {}))
    return {r.pair: r for r in read_records(lake, CALIBRATIONS, CalibrationRecord)}


def off_deg(record, truth):
    return np.degrees(errors_at_targets(record.pair, transform_of(record), truth[record.pair])[:2])


@pytest.mark.slow
def test_the_day_without_a_fault_is_accepted_and_names_none(day, tmp_path):
    records = records_of(*day[:2], Lake.at(tmp_path))
    for pair in ("camera_lidar", "lidar_radar"):
        assert (records[pair].status, list(records[pair].faults)) == ("accepted", []), records[pair].reason


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_stopped_and_named_and_what_it_does_not_touch_is_right(name, day, tmp_path):
    (folder, logs, truth), (topics, edit, stopped, names) = day, FAULTS[name]
    edited = edits.rewrite_logs(logs, tmp_path / "logs", topics, edit() if edit is edits.stuck else edit)
    records = records_of(folder, edited, Lake.at(tmp_path / "lake"))
    for pair in stopped:
        assert records[pair].status != "accepted"
        assert names & set(records[pair].faults), (records[pair].faults, records[pair].reason)
    for record in records.values():
        if record.status == "accepted" and "camera" in record.pair:
            assert off_deg(record, truth).max() < 0.2

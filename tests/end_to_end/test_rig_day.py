"""A day of two cameras, a lidar and two radars, from logs to a pose of every sensor with the truth beside it."""

from collections import Counter

import numpy as np
import pytest
from scipy.linalg import eigh

from jobs.terminal.demo_table import errors_of, print_comparison
from pipeline.core.stage_work import Task
from pipeline.core.stages import CALIBRATE
from pipeline.rig.se3 import inverse, log_se3
from pipeline.store.current import current_poses, prior_of, transform_of
from pipeline.store.partitions import Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.poses import POSES, PoseRow
from tests.makers.simulated_days import simulated_day

pytestmark = pytest.mark.slow
DAY, MOMENTS = Partition("vehicle-1", "2026-03-02"), 60


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    about = {"rig": "duo", "environment": "mixed", "seed": 31}
    made = simulated_day(tmp_path_factory.mktemp("duo"), frames=MOMENTS, drives=2, **about)
    task = Task(fleet=made.fleet, lake=made.lake, of=DAY, method="joint")
    outcome = CALIBRATE.run(task)
    return task, outcome, {name: np.array(T) for name, T in made.told["T_base_sensor"].items()}


def poses_of(task):
    return {p.sensor: p for p in current_poses(read_records(task.lake, POSES, PoseRow))}


def test_every_edge_has_a_record_and_every_sensor_a_pose(day):
    task, outcome, _ = day
    records = read_records(task.lake, CALIBRATIONS, CalibrationRecord)
    assert outcome.status == "done"
    assert len(records) == outcome.rows
    names = {(r.parent_frame, r.child_frame) for r in records}
    assert {("front", "top"), ("left", "top"), ("top", "nose"), ("front", "nose")} <= names
    poses = poses_of(task)
    assert set(poses) == {node.name for node in task.fleet.rig_of(DAY.vehicle).nodes}
    assert np.array_equal(transform_of(poses["top"]), np.eye(4))  # the reference, which the others refer to


def test_the_table_of_the_demo_compares_every_edge_with_the_truth(day, capsys):
    task, _, truth = day
    known = {(DAY.vehicle, DAY.day): truth | {"base": np.eye(4)}}
    errors = errors_of(task.lake, "joint", known, DAY.day)
    of_kinds = {"camera_lidar": 2, "camera_radar": 4, "lidar_radar": 2}
    of_kinds |= {"lidar_base": 1, "radar_base": 2, "camera_base": 2}
    assert Counter(e["pair"] for e in errors) == of_kinds
    assert all(0 < e["rotation_error_prior_deg"] < 6 for e in errors if e["status"] != "refused")
    print_comparison(task.lake, "joint", known, DAY.day, [])
    printed = capsys.readouterr().out
    assert all(f"{e['parent_frame']}_{e['child_frame']}" in printed for e in errors)


def test_what_is_accepted_is_right(day):
    task, _, truth = day
    for name, pose in poses_of(task).items():
        if pose.status != "accepted" or name in ("base", "top"):
            continue
        off = log_se3(inverse(truth["top"]) @ truth[name] @ inverse(transform_of(pose)))
        sigma = np.sqrt(np.diag(pose.covariance))
        assert (np.abs(off) <= np.maximum(4 * sigma, np.radians(0.1))).all(), name


def test_a_pose_has_the_prior_that_is_in_it_and_is_surer_along_every_direction(day):
    task, _, truth = day
    checked = 0
    for name, pose in poses_of(task).items():
        if pose.status == "refused" or name == "top":
            assert pose.prior_covariance is None
            continue
        off = log_se3(inverse(truth["top"]) @ truth.get(name, np.eye(4)) @ inverse(prior_of(pose)))
        assert np.sqrt(off @ np.linalg.solve(pose.prior_covariance, off)) < 5.0, name
        shares = eigh(pose.covariance - pose.common_covariance, pose.prior_covariance, eigvals_only=True)
        assert shares.max() < 1.01, name
        assert shares.min() < 0.1, name
        checked += 1
    assert checked >= 3


def test_the_same_work_is_not_done_again_and_its_poses_are_current(day):
    task, outcome, _ = day
    again = CALIBRATE.run(task)
    assert again.status == "cached"
    assert again.work_key == outcome.work_key
    assert len(read_records(task.lake, POSES, PoseRow)) == len(poses_of(task))

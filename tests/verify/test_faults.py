"""Faults that are put into captures change what they name, and nothing else."""

import cv2
import numpy as np
import pytest

from pipeline.rig.graph import Sensor
from pipeline.store.moments import joined
from pipeline.store.partitions import Lake
from pipeline.verify.faults import FAULTS_OF, Fault, copy_with_fault, faults_of_log
from schemas.moments import MOMENTS
from tests.makers.simulated_days import simulated_day

ASKED_RAD = np.radians(0.5)


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    return simulated_day(tmp_path_factory.mktemp("day"), frames=9, seed=5)


def captures(day, fault, tmp_path):
    lake = Lake.at(tmp_path / "faulty")
    copy_with_fault(day.lake, day.partition, fault, ASKED_RAD, lake)
    return [[row for _, row in joined(of, MOMENTS, day.partition)] for of in (day.lake, lake)]


@pytest.mark.parametrize("words", list(FAULTS_OF["camera"]))
def test_a_fault_of_the_camera_changes_the_camera_alone(words, day, tmp_path):
    before, after = captures(day, Fault("camera", "camera", words), tmp_path)
    assert len(before) == len(after)
    for old, new in zip(before, after, strict=True):
        assert old["camera"].stamp_ns == new["camera"].stamp_ns
        assert np.array_equal(old["lidar"].lidar_xyz_m, new["lidar"].lidar_xyz_m)
    old, new = before[3]["camera"], after[3]["camera"]
    labels = [cv2.imdecode(np.frombuffer(c.labels_png, np.uint8), 0) for c in (old, new)]
    turn_rad = np.arctan((new.camera_K[0, 2] - old.camera_K[0, 2]) / old.camera_K[0, 0])
    if words == "labels shifted":
        px = round(old.camera_K[0, 0] * np.tan(ASKED_RAD) * labels[0].shape[1] / old.image_width_px)
        assert px >= 1
        assert np.mean(labels[0][:, : -px - 1] == labels[1][:, px:-1]) > 0.95
    elif words.startswith("every third"):
        assert old.image == after[4]["camera"].image or old.image != new.image
        assert [
            np.array_equal(a["camera"].image, b["camera"].image) for a, b in zip(before, after, strict=True)
        ] == [bool(k % 3) for k in range(len(before))]
    elif "principal" in words:
        assert turn_rad == pytest.approx(ASKED_RAD, rel=1e-6)
    else:
        assert new.camera_K[0, 0] / old.camera_K[0, 0] == pytest.approx(1.02)


@pytest.mark.parametrize(("words", "change"), [("mirrored", [1, -1, 1]), ("points 0.3 m too high", None)])
def test_a_fault_of_the_lidar_changes_its_points(words, change, day, tmp_path):
    before, after = captures(day, Fault("lidar", "lidar", words), tmp_path)
    old, new = (rows[2]["lidar"].lidar_xyz_m for rows in (before, after))
    expected = old * np.array(change) if change else old + [0, 0, 0.3]
    assert np.allclose(new, expected, atol=1e-4)
    assert before[2]["camera"].image == after[2]["camera"].image


def test_faults_take_turns_over_logs():
    sensors = [Sensor("camera", "camera"), Sensor("lidar", "lidar"), Sensor("radar", "radar")]
    seen = {f.name for log in range(6) for f in faults_of_log(sensors, 1, f"{log:x}")}
    assert len(seen) == 6
    assert not any("labels" in f.words for f in faults_of_log(sensors, 9, "0", labelled=False))
    assert faults_of_log([], 3, "0") == []

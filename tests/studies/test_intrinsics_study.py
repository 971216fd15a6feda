"""The study of intrinsics counts what was told of each fault, and measures against the camera's true intrinsics."""

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.intrinsics import DayIntrinsics
from tests.benchmarks.studies import intrinsics
from tests.benchmarks.studies.days import DaySpec


def result(fault, focal, true_focal, told=()):
    centre = np.array([6.0, -3.0])
    found = DayIntrinsics(focal, 0.005, centre, np.array([20.0, 4.0]), (900.0, 900.0))
    return intrinsics.Measured(DaySpec(1, "urban"), fault, found, true_focal, np.array([2.0, 0.0]), told)


def test_tables_count_what_was_told_and_measure_against_the_truth():
    told = ("CameraInfo's focal length is contradicted by the day: measured -2.8%",)
    results = [
        result("focal:0.03", 0.972, 0.97, told),
        result("focal:0.03", 0.976, 0.97),
        *(result(fault, 1.0, 1.0) for fault in intrinsics.FAULTS if fault != "focal:0.03"),
    ]
    lines = list(intrinsics._tables(results))
    (row,) = [line for line in lines if line.startswith("| focal:0.03")]
    days, held_focal, held_centre, rms_percent, z = (float(c) for c in row.split("|")[2:-1])
    assert (days, held_focal, held_centre) == (2, 1, 0)
    assert rms_percent == pytest.approx(100 * np.sqrt((0.002**2 + 0.006**2) / 2), abs=0.01)
    assert z == pytest.approx(np.sqrt((0.4**2 + 1.2**2) / 2), abs=0.01)
    assert "| paper | 4.0, 3.0 | 20.0, 4.0 | 0.2, 0.8 |" in lines

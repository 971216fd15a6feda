"""Real logs whose fleet.toml names no semantics, from logs to the record of camera-lidar."""

import numpy as np
import pytest

from pipeline.geometry.targets import errors_at_targets
from schemas.observations import WITHOUT_LABELS
from tests.accuracy.days import SHARED
from tests.benchmarks.studies.metrics import LIMITS_DEG, transform_of
from tests.benchmarks.studies.without_semantics import LOGS, day_of, found_from

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (SHARED / "astyx").is_dir(), reason="the recordings are not beside this repository"
    ),
]
# How far from the truth, beside the limit, a reference may be: the real car's is good to .2 deg.
REFERENCE_DEG = {"real_car": 0.2, "other_world": 0.0, "kitti": 0.1}

ACCEPTED = {
    "other_world"
}  # from every start; the real car is held from some, whose azimuth is known to .08 deg


@pytest.fixture(scope="module")
def day(request, tmp_path_factory):
    name = request.param
    if not sorted(SHARED.glob(LOGS[name][0])):
        pytest.skip(f"no recordings of {name} beside this repository")
    return name, *day_of(name, tmp_path_factory.mktemp(name))


def off_deg(record, true):
    return float(
        np.degrees(np.max(errors_at_targets("camera_lidar", transform_of(record), true.T_camera_lidar)[:2]))
    )


@pytest.mark.parametrize("day", ["real_car", "other_world"], indirect=True)
def test_a_real_log_without_labels_is_right_from_two_degrees_and_says_how(day):
    name, rows, fleet, true = day
    assert all(o.is_unlabelled for o in rows if "camera" in o.sensors)
    record, _ = found_from(rows, fleet, true, 2.0, 41)
    unsure_only = record.diagnostics["unsure_only"] > 0
    assert record.status == "accepted" or (unsure_only and name not in ACCEPTED), record.reason
    assert off_deg(record, true) < LIMITS_DEG["camera_lidar"] + REFERENCE_DEG[name]
    assert WITHOUT_LABELS in record.notes


@pytest.mark.parametrize("day", ["real_car", "kitti"], indirect=True)
@pytest.mark.parametrize(("deg", "is_hidden"), [(5.0, False), (5.0, True)])
def test_a_start_far_off_is_not_accepted_wrong(day, deg, is_hidden):
    name, rows, fleet, true = day
    record, _ = found_from(rows, fleet, true, deg, 42, is_hidden=is_hidden)
    is_right = off_deg(record, true) < LIMITS_DEG["camera_lidar"] + REFERENCE_DEG[name]
    assert record.status != "accepted" or is_right, record.reason

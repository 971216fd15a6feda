"""Through the whole stage: labels a little beside their picture are moved back and named, others hold their pair."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.calibrate.records import Inputs
from pipeline.rig.estimates import Prior
from pipeline.rig.targets import errors_at_targets
from pipeline.store.current import targets_of, transform_of
from pipeline.store.partitions import Partition
from tests.makers.calibrated_days import records_of_rows
from tests.makers.simulated_days import simulated_day

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return simulated_day(
        tmp_path_factory.mktemp("day"), frames=40, environment="urban", rig="paper", seed=174
    )


def moved(o, right_px):
    """The frame with its labels further right: borders are whole pixels further, the picture's stay."""
    labels = cv2.imdecode(np.frombuffer(o.labels_png, np.uint8), cv2.IMREAD_UNCHANGED)
    labels = np.roll(labels, right_px, 1)
    gradients = o.label_gradients.copy()
    across = [0, 1, 4, 5]
    gradients[across] = np.roll(gradients[across], -right_px, -1)
    return replace(o, labels_png=cv2.imencode(".png", labels)[1].tobytes(), label_gradients=gradients)


@pytest.fixture(scope="module")
def record_at(made):
    known = {}

    def get(right_px):
        if right_px not in known:
            prior = Prior(made.truth["camera_lidar"], made.truth["lidar_radar"], np.radians(2.0), 0.05)
            about = Inputs(Partition("vehicle-1", "2026-03-02"), "joint", "k", 1, ("camera_lidar",))
            rows = [moved(o, right_px) for o in made.observations]
            known[right_px] = {r.pair: r for r in records_of_rows(rows, prior, made.fleet, about)}
        return known[right_px]["camera_lidar"]

    return get


def azimuth_error(record, truth):
    T = transform_of(record)
    return np.degrees(errors_at_targets("camera_lidar", T, truth, targets_of(record))[0])


def test_labels_one_pixel_beside_are_moved_back_and_named_in_an_accepted_record(made, record_at):
    good, beside, truth = record_at(0), record_at(1), made.truth["camera_lidar"]
    assert (good.status, beside.status) == ("accepted", "accepted")
    assert (good.faults, beside.faults) == ([], ["labels_offset"])
    assert "-1.0 +- 0.1 label px right" in beside.reason
    assert "moved back" in beside.reason
    assert azimuth_error(beside, truth) < azimuth_error(good, truth) + 0.02
    # A pixel is .13 deg: that is what the pose was moved by, give or take what does not rest on labels.
    assert 0.05 < abs(beside.diagnostics["labels_moved_yaw_deg"]) < 0.16
    assert beside.azimuth_sigma_rad > good.azimuth_sigma_rad


def test_labels_further_beside_than_the_limit_hold_camera_lidar_by_name(record_at):
    beside = record_at(3)
    assert (beside.status, beside.faults) == ("held", ["labels_offset"])
    assert "-3.0 +- 0.1 label px right" in beside.reason
    assert beside.diagnostics["unsure_only"] == 0

"""Faults of a simulated day: what they move, what the log then holds, and what text they are read from."""

import json
from functools import cache

import cv2
import numpy as np
import pytest

from pipeline.core.errors import ConfigError
from pipeline.rig.se3 import inverse, log_so3
from pipeline.rig.topics import TOPICS
from pipeline.simulate.faults import Fault, parse_faults
from pipeline.simulate.fleet import FleetSpec, mounting_on, simulate_vehicle_day

DAYS = ["2026-03-02", "2026-03-03", "2026-03-04"]
QUIET = {"vehicles": 2, "days": 3, "frames": 1, "drives": 1, "environments": "urban"}


def spec_with(*faults):
    return FleetSpec(**QUIET, faults=faults)


def turned_deg(spec, day, share):
    """Turn of a pair's true transform against the same day without faults."""
    T, T0 = (mounting_on(s, 0, day, share).between("camera", "lidar") for s in (spec, FleetSpec(**QUIET)))
    return np.degrees(np.linalg.norm(log_so3((T @ inverse(T0))[:3, :3])))


@pytest.mark.parametrize(
    ("fault", "moments", "expected"),
    [
        ("1:camera:yaw:1.2", [(0, 1.0), (1, 0.0), (2, 1.0)], [0, 1.2, 1.2]),
        ("1:radar:yaw:1.2", [(0, 1.0), (1, 0.0), (2, 1.0)], [0, 0, 0]),  # of no pair that is asked for
        ("1:lidar:drift-pitch:0.2", [(0, 1.0), (1, 1.0), (2, 1.0)], [0, 0.2, 0.4]),
        ("1:camera:yaw:0.5@0.6", [(0, 1.0), (1, 0.0), (1, 0.59), (1, 0.61), (2, 0.0)], [0, 0, 0, 0.5, 0.5]),
        ("1:lidar:warm-pitch:0.3", [(1, 0.0), (1, 0.5), (1, 1.0), (2, 0.5)], [0, 0.15, 0.3, 0]),
    ],
    ids=["from a day on", "of another sensor", "grows day by day", "begins within a day", "warms up and is back"],
)  # fmt: skip
def test_a_motion_over_time_is_as_far_as_the_day_has_come(fault, moments, expected):
    spec = spec_with(*parse_faults(f"vehicle-1:{fault}", DAYS))
    turned = [turned_deg(spec, day, share) for day, share in moments]
    np.testing.assert_allclose(turned, expected, atol=1e-6)


def test_a_shift_moves_the_sensor_and_a_late_clock_the_stamps():
    spec = spec_with(Fault("vehicle-1", 1, "camera", "z", 0.05), Fault("vehicle-1", 1, "radar", "time", 0.03))
    before, after = (mounting_on(s, 0, 1) for s in (FleetSpec(**QUIET), spec))
    np.testing.assert_allclose(
        after["camera"].T_vehicle[:3, 3] - before["camera"].T_vehicle[:3, 3], [0, 0, 0.05], atol=1e-12
    )
    assert after["radar"].delay_s - before["radar"].delay_s == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("remount", "low_deg", "high_deg"), [({}, 0.005, 0.15), ({"remount_deg": 0.5}, 0.2, 4.0)]
)
def test_the_daily_remount_is_small_beside_a_knock_but_for_a_rig_that_is_taken_off(
    remount, low_deg, high_deg
):
    spec = FleetSpec(**QUIET | {"days": 20}, **remount)
    first, *others = (mounting_on(spec, 0, day).between("lidar", "radar") for day in range(20))
    turns = [np.linalg.norm(log_so3((T @ inverse(first))[:3, :3])) for T in others]
    assert low_deg < np.degrees(np.mean(turns)) < high_deg


@pytest.fixture(scope="module")
def logged(tmp_path_factory, read, the_log):
    """First messages by topic, and the truth, of a day with these faults of the first vehicle."""

    @cache
    def run(*faults):
        out = tmp_path_factory.mktemp("day")
        spec = spec_with(*parse_faults(",".join(f"vehicle-1:1:{f}" for f in faults), DAYS))
        simulate_vehicle_day(spec, 0, 1, out)
        found = {}
        for topic, _, message in read(the_log(out)):
            found.setdefault(topic, message)
        return found, json.loads((out / "truth" / "vehicle-1" / f"{DAYS[1]}.json").read_text())

    return run


def decoded(message):
    return cv2.imdecode(np.asarray(message.data), cv2.IMREAD_UNCHANGED)


def wrong_labels(found, good):
    return np.mean(decoded(found[TOPICS["labels"]]) != decoded(good[TOPICS["labels"]]))


def test_wrong_intrinsics_are_in_the_log_and_in_the_truth_but_not_in_the_image(logged):
    good, truth = logged()
    bad, spoiled = logged(
        "camera:intrinsics:0.05", "camera:centre:4", "camera:centre-v:-3", "camera:labels:1"
    )
    K, K_logged = np.array(good[TOPICS["info"]].k), np.array(bad[TOPICS["info"]].k)
    wrong = K.reshape(3, 3) * [[1.05, 1, 1], [1, 1.05, 1], [1, 1, 1]] + [[0, 0, 4], [0, 0, -3], [0, 0, 0]]
    np.testing.assert_allclose(K_logged.reshape(3, 3), wrong, atol=1e-9)
    np.testing.assert_allclose(np.array(spoiled["camera_K_logged"]).ravel(), K_logged)
    assert spoiled["camera_K"] == truth["camera_K"]
    np.testing.assert_array_equal(bad[TOPICS["image"]].data, good[TOPICS["image"]].data)
    assert wrong_labels(bad, good) > 0.5


def test_night_is_dark_and_confuses_the_networks_and_dusk_less(logged):
    good, _ = logged()
    wrong = {}
    for kind in ("dusk", "night"):
        dark, truth = logged(f"camera:{kind}:1")
        assert decoded(dark[TOPICS["image"]]).mean() < 0.75 * decoded(good[TOPICS["image"]]).mean()
        wrong[kind] = wrong_labels(dark, good)
        assert truth["drives"][0]["night"]
    assert 0.02 < wrong["dusk"] < 0.6 * wrong["night"]
    assert wrong["night"] > 0.1


def test_faults_are_read_from_text_by_day_or_number():
    text = "vehicle-2:2026-03-03:radar:yaw:1.2, vehicle-1:0:camera:time:-0.02"
    first, second = parse_faults(text, DAYS)
    assert first == Fault("vehicle-2", 1, "radar", "yaw", 1.2)
    assert second == Fault("vehicle-1", 0, "camera", "time", -0.02)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("vehicle-1:0:radar:yaw", "expected vehicle:day:sensor:kind:amount"),
        ("vehicle-1:0:radar:wobble:1", "wobble"),
        ("vehicle-1:0:sonar:yaw:1", "sonar"),
        ("vehicle-1:7:radar:yaw:1", "day '7'"),
        ("vehicle-1:0:radar:yaw:much", "much"),
        ("vehicle-1:0:lidar:time:0.1", "camera or radar"),
        *(
            (f"vehicle-1:1:camera:{i}", "cannot begin after")
            for i in ("night:1@0.5", "warm-yaw:1@0.5", "yaw:1@1.5")
        ),
        ("vehicle-1:1:camera:yaw:1@noon", "no number"),
        ("vehicle-9:1:radar:yaw:1", "vehicle-9"),
        *((f"vehicle-1:0:{item}", "happens to") for item in ("radar:intrinsics:0.1", "camera:swap:1")),
    ],
)
def test_a_fault_that_cannot_be_is_refused_with_what_is_wrong(text, names):
    with pytest.raises(ConfigError, match=names):
        spec_with(*parse_faults(text, DAYS))

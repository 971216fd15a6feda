import json

import cv2
import numpy as np
import pytest

from pipeline.core.errors import ConfigError
from pipeline.rig.se3 import inverse, log_so3
from pipeline.rig.topics import TOPICS
from pipeline.simulate.faults import Fault, faults_on, parse_faults
from pipeline.simulate.fleet import FleetSpec, mounting_on, simulate_vehicle_day

DAYS = ["2026-03-02", "2026-03-03", "2026-03-04"]
QUIET = {"vehicles": 2, "days": 3, "frames": 1, "drives": 1, "environments": "urban"}


def spec_with(*faults):
    return FleetSpec(**QUIET, faults=faults)


def moved_deg(spec, day, pair):
    """Turn of a pair's true transform against the same day without faults."""
    T, T0 = (mounting_on(s, 0, day).between(*pair) for s in (spec, FleetSpec(**QUIET)))
    return np.degrees(np.linalg.norm(log_so3((T @ inverse(T0))[:3, :3])))


def test_a_knocked_radar_moves_its_two_pairs_from_that_day_on_and_no_other():
    spec = spec_with(Fault("vehicle-1", 1, "radar", "yaw", 1.2))
    for pair in (("lidar", "radar"), ("camera", "radar")):
        assert moved_deg(spec, 0, pair) == pytest.approx(0, abs=1e-9)
        assert moved_deg(spec, 1, pair) == pytest.approx(1.2, abs=1e-6)
        assert moved_deg(spec, 2, pair) == pytest.approx(1.2, abs=1e-6)
    assert moved_deg(spec, 2, ("camera", "lidar")) == pytest.approx(0, abs=1e-9)
    other = mounting_on(spec, 1, 2).between("lidar", "radar")
    np.testing.assert_array_equal(other, mounting_on(FleetSpec(**QUIET), 1, 2).between("lidar", "radar"))


def test_a_slow_drift_grows_day_by_day():
    spec = spec_with(Fault("vehicle-1", 1, "lidar", "drift-pitch", 0.2))
    turned = [moved_deg(spec, day, ("camera", "lidar")) for day in range(3)]
    np.testing.assert_allclose(turned, [0.0, 0.2, 0.4], atol=1e-6)


def test_a_knock_within_a_day_spares_its_first_frames_and_stays_for_good():
    spec = spec_with(*parse_faults("vehicle-1:1:camera:yaw:0.5@0.6", DAYS))

    def turned_deg(day, share):
        T = mounting_on(spec, 0, day, share).between("camera", "lidar")
        T0 = mounting_on(FleetSpec(**QUIET), 0, day).between("camera", "lidar")
        return np.degrees(np.linalg.norm(log_so3((T @ inverse(T0))[:3, :3])))

    turned = [
        turned_deg(0, 1.0),
        turned_deg(1, 0.0),
        turned_deg(1, 0.59),
        turned_deg(1, 0.61),
        turned_deg(2, 0.0),
    ]
    np.testing.assert_allclose(turned, [0, 0, 0, 0.5, 0.5], atol=1e-6)


def test_a_sensor_that_warms_up_moves_over_the_day_and_is_back_the_next():
    spec = spec_with(*parse_faults("vehicle-1:1:lidar:warm-pitch:0.3", DAYS))
    pitch = [
        mounting_on(spec, 0, d, s)["lidar"].T_vehicle for d, s in ((1, 0.0), (1, 0.5), (1, 1.0), (2, 0.5))
    ]
    still = [mounting_on(FleetSpec(**QUIET), 0, d)["lidar"].T_vehicle for d in (1, 1, 1, 2)]
    turns = [log_so3(T[:3, :3] @ T0[:3, :3].T) for T, T0 in zip(pitch, still, strict=True)]
    np.testing.assert_allclose(np.degrees(turns), [[0, a, 0] for a in (0, 0.15, 0.3, 0)], atol=1e-9)


@pytest.mark.parametrize("item", ["night:1@0.5", "warm-yaw:1@0.5", "yaw:1@1.5", "yaw:1@noon"])
def test_what_cannot_begin_within_a_day_is_refused(item):
    with pytest.raises(ConfigError, match=r"cannot begin after|no number"):
        parse_faults(f"vehicle-1:1:camera:{item}", DAYS)


def test_a_knock_within_a_day_is_seen_by_its_later_frames_only(tmp_path, read, the_log):
    quiet = {**QUIET, "vehicles": 1, "days": 1, "frames": 2}
    clouds = {}
    for name, faults in (("still", ""), ("knocked", "vehicle-1:0:lidar:yaw:5@0.5")):
        spec = FleetSpec(**quiet, faults=parse_faults(faults, DAYS))
        simulate_vehicle_day(spec, 0, 0, tmp_path / name)
        messages = read(the_log(tmp_path / name))
        clouds[name] = [bytes(m.data) for topic, _, m in messages if topic == TOPICS["lidar"]]
    assert clouds["still"][0] == clouds["knocked"][0]
    assert clouds["still"][1] != clouds["knocked"][1]


def test_a_shift_moves_the_sensor_and_a_late_clock_the_stamps():
    spec = spec_with(Fault("vehicle-1", 1, "camera", "z", 0.05), Fault("vehicle-1", 1, "radar", "time", 0.03))
    before, after = (mounting_on(s, 0, 1) for s in (FleetSpec(**QUIET), spec))
    np.testing.assert_allclose(
        after["camera"].T_vehicle[:3, 3] - before["camera"].T_vehicle[:3, 3], [0, 0, 0.05], atol=1e-12
    )
    assert after["radar"].delay_s - before["radar"].delay_s == pytest.approx(0.03)


def test_the_daily_remount_is_small_beside_a_knock():
    spec = FleetSpec(**QUIET | {"days": 20})
    first = mounting_on(spec, 0, 0).between("lidar", "radar")
    turns = [
        np.degrees(
            np.linalg.norm(
                log_so3((mounting_on(spec, 0, d).between("lidar", "radar") @ inverse(first))[:3, :3])
            )
        )
        for d in range(1, 20)
    ]
    assert 0.005 < np.mean(turns) < 0.15


def test_a_rig_that_is_taken_off_every_evening_comes_back_otherwise():
    spec = FleetSpec(**QUIET, remount_deg=0.5)
    first, second = (mounting_on(spec, 0, day).between("lidar", "radar") for day in (0, 1))
    assert 0.2 < np.degrees(np.linalg.norm(log_so3((first @ inverse(second))[:3, :3]))) < 4.0


@pytest.fixture
def logged(read, the_log):
    def run(spec, out):
        return first_messages(spec, out, read, the_log)

    return run


def first_messages(spec, tmp_path, read, the_log):
    simulate_vehicle_day(spec, 0, 1, tmp_path)
    found = {}
    for topic, _, message in read(the_log(tmp_path)):
        found.setdefault(topic, message)
    return found, json.loads((tmp_path / "truth" / "vehicle-1" / f"{DAYS[1]}.json").read_text())


def decoded(message):
    return cv2.imdecode(np.asarray(message.data), cv2.IMREAD_UNCHANGED)


def test_a_missing_sensor_is_missing_and_the_others_are_not(tmp_path, logged):
    found, truth = logged(spec_with(Fault("vehicle-1", 1, "lidar", "missing", 1.0)), tmp_path)
    assert TOPICS["lidar"] not in found
    assert {TOPICS["image"], TOPICS["radar"]} <= found.keys()
    assert truth["faults"][0]["kind"] == "missing"


def test_swapped_sensors_carry_one_another_s_points(tmp_path, logged):
    found, _ = logged(spec_with(Fault("vehicle-1", 1, "radar", "swap", 1.0)), tmp_path)
    assert "doppler" in [f.name for f in found[TOPICS["lidar"]].fields]
    assert "ring" in [f.name for f in found[TOPICS["radar"]].fields]


def test_bad_days_spoil_what_they_say(tmp_path, logged):
    good, truth = logged(FleetSpec(**QUIET), tmp_path / "good")
    bad, spoiled = logged(
        spec_with(
            Fault("vehicle-1", 1, "camera", "intrinsics", 0.05),
            Fault("vehicle-1", 1, "camera", "labels", 1.0),
        ),
        tmp_path / "bad",
    )
    assert bad[TOPICS["info"]].k[0] / good[TOPICS["info"]].k[0] == pytest.approx(1.05)
    assert spoiled["camera_K"] == truth["camera_K"]
    np.testing.assert_array_equal(bad[TOPICS["image"]].data, good[TOPICS["image"]].data)
    assert np.mean(decoded(bad[TOPICS["labels"]]) != decoded(good[TOPICS["labels"]])) > 0.5


def test_a_wrong_principal_point_is_in_the_log_and_in_the_truth_but_not_in_the_image(tmp_path, logged):
    good, truth = logged(FleetSpec(**QUIET), tmp_path / "good")
    bad, spoiled = logged(
        spec_with(
            Fault("vehicle-1", 1, "camera", "centre", 4.0), Fault("vehicle-1", 1, "camera", "centre-v", -3.0)
        ),
        tmp_path / "bad",
    )
    shift = np.array(bad[TOPICS["info"]].k) - np.array(good[TOPICS["info"]].k)
    np.testing.assert_allclose(shift.reshape(3, 3), [[0, 0, 4], [0, 0, -3], [0, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(np.array(spoiled["camera_K_logged"]).ravel(), bad[TOPICS["info"]].k)
    assert spoiled["camera_K"] == truth["camera_K"]
    np.testing.assert_array_equal(bad[TOPICS["image"]].data, good[TOPICS["image"]].data)


def test_dusk_is_dark_and_blurs_outlines_but_confuses_less_than_night(tmp_path, logged):
    wrong = {}
    good, _ = logged(FleetSpec(**QUIET), tmp_path / "day")
    for kind in ("dusk", "night"):
        dark, _ = logged(spec_with(Fault("vehicle-1", 1, "camera", kind, 1.0)), tmp_path / kind)
        assert decoded(dark[TOPICS["image"]]).mean() < 0.75 * decoded(good[TOPICS["image"]]).mean()
        wrong[kind] = np.mean(decoded(dark[TOPICS["labels"]]) != decoded(good[TOPICS["labels"]]))
    assert 0.02 < wrong["dusk"] < 0.6 * wrong["night"]


def test_night_is_dark_and_confuses_the_networks(tmp_path, logged):
    good, _ = logged(FleetSpec(**QUIET), tmp_path / "day")
    dark, truth = logged(spec_with(Fault("vehicle-1", 1, "camera", "night", 1.0)), tmp_path / "night")
    assert decoded(dark[TOPICS["image"]]).mean() < 0.75 * decoded(good[TOPICS["image"]]).mean()
    assert np.mean(decoded(dark[TOPICS["labels"]]) != decoded(good[TOPICS["labels"]])) > 0.1
    assert truth["drives"][0]["night"]


def test_faults_on_another_day_leave_this_one_alone():
    faults = (Fault("vehicle-1", 2, "lidar", "missing", 1.0), Fault("vehicle-1", 2, "camera", "few", 3.0))
    assert not faults_on(faults, "vehicle-1", 1).faults
    assert faults_on(faults, "vehicle-1", 2).has("missing", "lidar")
    assert not faults_on(faults, "vehicle-1", 2).has("missing", "camera")
    assert faults_on(faults, "vehicle-1", 2).amount("few") == 3


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
    ],
)
def test_a_fault_that_cannot_be_is_refused_with_what_is_wrong(text, names):
    with pytest.raises(ConfigError, match=names):
        parse_faults(text, DAYS)


def test_a_fault_of_an_unknown_vehicle_is_refused():
    with pytest.raises(ConfigError, match="vehicle-9"):
        spec_with(Fault("vehicle-9", 1, "radar", "yaw", 1.2))

"""The study of faults: edits of logs do what they say, and outcomes are told apart."""

import numpy as np
import pytest

from pipeline.geometry.se3 import exp_so3
from pipeline.ros_messages import RosMessages
from schemas.faults import FAULTS
from tests.benchmarks.studies import fault_logs
from tests.benchmarks.studies.fault_logs import EDITS, Place
from tests.benchmarks.studies.faults import CASES, is_right, outcome_of, runs_of

LATE, EARLY = Place(9, 0.9, "radar_front"), Place(0, 0.0, "radar_front")
ROS = RosMessages(2)
XYZ = np.array([[10.0, 2.0, 1.0], [20.0, -4.0, 0.5]], np.float32)


def cloud():
    columns = dict(zip("xyz", XYZ.T, strict=True)) | {"doppler": np.array([1.5, -2.0], np.float32)}
    return ROS.cloud(ROS.header(5_000_000_000, "radar_front"), columns)


def rows_of(message):
    return np.frombuffer(message.data.tobytes(), np.float32).reshape(-1, 4)


def test_every_case_has_an_edit_or_is_simulated_and_names_known_faults():
    assert all(c.simulated or c.name in EDITS or c.name == "good" for c in CASES)
    assert set().union(*(c.named for c in CASES)) <= set(FAULTS)
    assert len({(c.name, c.amount) for c in CASES}) == len(CASES)


def test_there_are_at_least_600_records_of_three_rigs():
    runs = runs_of(range(12), real=False)
    assert 3 * sum(r.case != "good" for r in runs) >= 600
    assert len({r.key for r in runs}) == len(runs)


def test_a_sensor_turned_at_noon_turns_its_later_points_only():
    edit = EDITS["radar yaw at noon"]
    np.testing.assert_array_equal(rows_of(edit.change(cloud(), 2.0, EARLY))[:, :3], XYZ)
    turned = rows_of(edit.change(cloud(), 2.0, LATE))[:, :3]
    R = exp_so3(np.array([0.0, 0.0, np.radians(2.0)]))
    np.testing.assert_allclose(turned @ R.T, XYZ, atol=1e-5)  # in the old axes they are where they were


def test_stamps_move_and_payloads_stick_without_touching_the_rest():
    data = ROS.serialised(cloud())
    later = EDITS["radar stamps"].change((data, {}), 0.25, LATE)
    message = fault_logs._STORE.deserialize_cdr(later, "sensor_msgs/msg/PointCloud2")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 250_000_000)
    np.testing.assert_array_equal(rows_of(message), rows_of(cloud()))
    held = {}
    first = EDITS["radar stuck"].change((data, held), 0.0, EARLY)
    other = ROS.serialised(EDITS["doppler"].change(cloud(), -1.0, LATE))
    stuck = EDITS["radar stuck"].change((other, held), 0.0, LATE)
    assert stuck[12:] == first[12:]
    assert other[12:] != first[12:]


def test_labels_move_by_label_pixels():
    pixels = np.zeros((20, 30), np.uint8)
    pixels[10, 10] = 7
    moved = fault_logs._warped(fault_logs._shift(1, 0))
    message = ROS.image(ROS.header(0, "camera"), fault_logs.cv2.imencode(".png", pixels)[1].tobytes(), "png")
    found = fault_logs.cv2.imdecode(moved(message, 3.0, LATE).data, -1)
    assert tuple(np.argwhere(found == 7)[0]) == (10, 13)


def record(status, error_deg, faults=(), determined=("azimuth", "elevation")):
    return {
        "status": status,
        "faults": list(faults),
        "determined": list(determined),
        "error_deg": error_deg,
        "sigma_deg": [0.03, 0.03],
        "limit_deg": [0.2, 0.2],
    }


@pytest.mark.parametrize(
    ("found", "outcome"),
    [
        (record("accepted", [0.05, 0.08]), "accepted, right"),
        (record("accepted", [0.05, 0.1]), "accepted, WRONG"),
        (record("accepted", [0.05, 0.1], determined=("azimuth",)), "accepted, right"),
        (record("held", [0.5, 0.1], ["labels_offset"]), "stopped, named rightly"),
        (record("held", [0.5, 0.1], ["prior"]), "stopped, named otherwise"),
        (record("held", [0.5, 0.1]), "stopped, not named"),
    ],
)
def test_an_outcome_says_whether_a_fault_was_stopped_and_named(found, outcome):
    line = {"case": "labels right", "amount": 3, "rig": "demo", "seed": 1, "pairs": {"camera_lidar": found}}
    good = {"pairs": {"camera_lidar": record("accepted", [0.0, 0.0])}}
    assert outcome_of("camera_lidar", line, good) == outcome


def test_a_direction_that_is_not_certified_cannot_be_wrong():
    assert is_right("camera_lidar", record("accepted", [0.05, 0.5], determined=("azimuth",)), "demo")
    assert not is_right("camera_lidar", record("accepted", [0.05, 0.5]), "demo")
    assert not is_right("camera_lidar", {"status": "refused"}, "demo")

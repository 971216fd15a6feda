"""The first sentence of a rig's page: what no pair of its sensors checks is said of the sensor."""

import pytest

from pipeline.report.day import Answered, answer_for, answered
from schemas.poses import PoseRow


def pose(sensor, kind):
    told = {"vehicle": "v", "day": "2026-03-02", "method": "joint", "work_key": "w", "code_version": "t"}
    return PoseRow(
        **told,
        sensor=sensor,
        kind=kind,
        reference="top",
        status="accepted",
        reason="",
        determined=["azimuth", "elevation"],
    )


@pytest.mark.parametrize(
    ("others", "verdict"),
    [((), "partly"), ((("rear", "radar"),), "good")],  # of many radars poses are of all edges, records of one
)
def test_a_roll_that_nothing_checks_is_named_of_the_sensor_whose_pose_is_the_pairs(others, verdict):
    view = Answered("top-nose", "accepted", ("top", "nose"), "azimuth", "roll (4.7 sigma)")
    poses = [pose(*s) for s in (("top", "lidar"), ("nose", "radar"), ("front", "camera"), *others)]
    found, sentence = answer_for(answered([view], poses), "2026-03-02", [])
    assert (found, "not in nose's roll (4.7 sigma)" in sentence) == (verdict, verdict == "partly")

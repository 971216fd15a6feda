"""The first sentence of a page names sensors where the day has their poses, else pairs."""

import pytest

from pipeline.report.day import Answered, answer_for, answered
from schemas.poses import PoseRow

PAIR = Answered("top-nose", "accepted", ("top", "nose"), "azimuth")


def pose(sensor, kind, status="accepted"):
    told = {"vehicle": "v", "day": "2026-03-02", "method": "joint", "work_key": "w", "code_version": "t"}
    told |= {"reference": "top", "reason": "", "determined": ["azimuth", "elevation"]}
    return PoseRow(**told, sensor=sensor, kind=kind, status=status)


@pytest.mark.parametrize(
    ("poses", "verdict", "words"),
    [
        ((), "good", "All pairs are accepted"),
        ((("top", "lidar"), ("nose", "radar")), "good", "All sensors are accepted"),
        (
            (("top", "lidar"), ("nose", "radar"), ("front", "camera", "held")),
            "partly",
            "Accepted: nose. Keep what the car has for front.",
        ),
    ],
)
def test_sensors_are_named_without_the_reference_and_pairs_only_without_poses(poses, verdict, words):
    found, sentence = answer_for(answered([PAIR], [pose(*p) for p in poses]), "2026-03-02", [])
    assert found == verdict
    assert words in sentence
    assert ("Certified in azimuth only: top-nose." in sentence) == (not poses)  # of poses, both are

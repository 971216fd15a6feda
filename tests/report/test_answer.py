"""The day page's first sentence: which sensors to trust, and no more than the records certify."""

import pytest

from pipeline.report.day import Answered, answer_for, answered
from schemas.poses import PoseRow

BOTH = "azimuth and elevation within 0.2 deg at 15 to 40 m; closest check: margin 0.30"
AZIMUTH = "azimuth within 0.4 deg at 15 to 40 m; closest check: margin 0.20"
NAMED = "Certified in azimuth only: lidar-radar."


@pytest.mark.parametrize(
    ("certified", "status", "verdict", "words", "never"),
    [
        (AZIMUTH, "accepted", "good", NAMED, "Keep"),
        (BOTH, "accepted", "good", "All pairs are accepted", "azimuth only"),
        (AZIMUTH, "held", "partly", "Keep what the car has for lidar-radar", "azimuth only"),
        (AZIMUTH, "refused", "partly", "Keep what the car has for lidar-radar", "azimuth only"),
    ],
)
def test_what_is_certified_in_one_direction_is_named_and_what_is_not_accepted_never_is(
    certified, status, verdict, words, never
):
    pairs = [Answered("camera-lidar", "accepted", ("camera", "lidar"), BOTH),
             Answered("lidar-radar", status, ("lidar", "radar"), certified)]  # fmt: skip
    found, sentence = answer_for(pairs, "2026-03-02", [])
    assert found == verdict
    assert words in sentence
    assert never not in sentence


def pose(sensor, kind, status="accepted"):
    told = {"vehicle": "v", "day": "2026-03-02", "method": "joint", "work_key": "w", "code_version": "t"}
    told |= {"reference": "top", "reason": "", "determined": ["azimuth", "elevation"]}
    return PoseRow(**told, sensor=sensor, kind=kind, status=status)


TWO = (("top", "lidar"), ("nose", "radar"))


@pytest.mark.parametrize(
    ("poses", "verdict", "words"),
    [
        ((), "good", "All pairs are accepted"),
        (TWO, "good", "All sensors are accepted"),
        ((*TWO, ("front", "camera", "held")), "partly", "Accepted: nose. Keep what the car has for front."),
    ],
)
def test_sensors_are_named_without_the_reference_and_pairs_only_without_poses(poses, verdict, words):
    pair = Answered("top-nose", "accepted", ("top", "nose"), "azimuth")
    found, sentence = answer_for(answered([pair], [pose(*p) for p in poses]), "2026-03-02", [])
    assert found == verdict
    assert words in sentence
    assert ("Certified in azimuth only: top-nose." in sentence) == (not poses)  # of poses, both are


def sensor(name, status="current", certified="azimuth, elevation"):
    return Answered(name, status, (name,), certified)


@pytest.mark.parametrize(
    ("loaded", "verdict", "words"),
    [
        (
            [sensor("nose", certified="azimuth"), sensor("front")], "good",
            "Yes. Load tonight's state: all sensors are certified, in azimuth or elevation at least. "
            + NAMED.replace("lidar-radar", "nose"),
        ),
        (
            [sensor("front", certified="elevation"), sensor("left", certified=""), sensor("nose", "prior", "")],
            "partly",
            ("Partly. Load tonight's state. Certified: front. Used, but not certified: left. At the prior: nose. "
             "Certified in elevation only: front."),
        ),
        (
            [sensor("left", certified=""), sensor("nose", "prior", "")], "bad",
            "No. Nothing in tonight's state is certified: keep what the car has.",
        ),
    ],
)  # fmt: skip
def test_a_page_that_shows_the_state_of_tonight_answers_for_it_and_not_for_the_day(loaded, verdict, words):
    pair = Answered("top-nose", "accepted", ("top", "nose"), "azimuth")
    held = answered([pair], [pose("left", "camera", "held"), pose("front", "camera")])
    assert answer_for(held, "2026-03-02", [], loaded) == (verdict, words)

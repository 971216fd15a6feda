"""The day page's first sentence claims no more than the records certify."""

import pytest

from pipeline.report.day import PairView, answer_for


def view(title, certified, status="accepted"):
    made = object.__new__(PairView)  # of all that a page shows of a pair, the answer looks at these four
    fields = {"title": title, "certified": certified, "status": status}
    fields["sensors"] = tuple(title.split("-"))
    for name, value in fields.items():
        object.__setattr__(made, name, value)
    return made


CAMERA_LIDAR = view("camera-lidar", "azimuth and elevation within 0.2 deg at 15 to 40 m; score 0.30")
RADAR = view("lidar-radar", "azimuth within 0.4 deg at 15 to 40 m; score 0.20")


def test_an_accepted_radar_whose_elevation_nobody_certifies_is_named():
    sort, sentence = answer_for([CAMERA_LIDAR, RADAR], "2026-03-02", [])
    assert sort == "good"
    assert sentence.endswith("Certified in azimuth only: lidar-radar.")


def test_where_both_directions_are_certified_nothing_is_added():
    assert "azimuth only" not in answer_for([CAMERA_LIDAR], "2026-03-02", [])[1]


@pytest.mark.parametrize("status", ["held", "refused"])
def test_a_pair_that_was_not_accepted_is_not_said_to_be_certified(status):
    sentence = answer_for([CAMERA_LIDAR, view("lidar-radar", RADAR.certified, status)], "2026-03-02", [])[1]
    assert "azimuth only" not in sentence
    assert "Keep what the car has for lidar-radar" in sentence

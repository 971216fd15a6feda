"""Detections that are seen too low: one unknown share that turns all who do not know of it, and its prior."""

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar.elevation_errors import SeenLow, added_share, seen_low_of
from pipeline.calibrate.joint.part_turn import PartTurn
from pipeline.objective.radar.heights import Heights, HeightScores
from pipeline.objective.radar.travel import TravelDirections

PER_SHARE_RAD = np.radians(5.0)


def ways(below):
    n = 12
    return TravelDirections(
        np.tile([10.0, 0.0, 0.0], (n, 1)), np.full(n, 0.01), np.zeros(n), np.full(n, -0.1), np.full(n, below),
        np.full(n, 0.08), np.arange(n),
    )  # fmt: skip


def heights(below):
    none = np.zeros(0)
    return Heights(0.0, np.eye(4), 0.3, 1.0, below, 0.05, HeightScores(none, none, none.astype(np.int64)))


def test_who_takes_all_for_seen_where_it_is_reads_higher_by_the_share_and_is_as_unsure_as_it():
    share = SeenLow(0.1, 0.06, {"registration": PER_SHARE_RAD})
    right = share.expected(PartTurn("registration", -0.1 * PER_SHARE_RAD, np.radians(0.4)))
    assert right.offset_rad == pytest.approx(0.0, abs=1e-12)
    assert np.degrees(right.sigma_rad) == pytest.approx(0.5)
    knows = PartTurn("heights", 0.01, 0.005)
    assert share.expected(knows) == knows


def test_two_that_are_turned_by_the_same_share_show_it_and_neither_errs_then():
    pitch, share, axis = 0.02, 0.12, np.array([0.0, 1.0])
    per_share = np.array([PER_SHARE_RAD, 2 * PER_SHARE_RAD])
    J = np.stack([added_share(axis, k, 2)[1] for k in per_share])
    read = pitch - share * per_share
    assert np.linalg.solve(J[:, 1:], read) == pytest.approx([pitch, share])


@pytest.mark.parametrize(("on_the_way", "displaced", "expected"), [(0.2, 0.03, 0.06), (0.04, 0.03, 0.04)])
def test_the_share_is_no_more_than_is_below_the_road_and_than_noise_images_and_strays_leave(
    on_the_way, displaced, expected
):
    found = seen_low_of(ways(on_the_way), heights(displaced))
    assert np.hypot(found.mean, found.sigma) == pytest.approx(expected, rel=1e-6)
    assert found.per_share_rad == pytest.approx({"registration": 0.08, "doppler": 0.1})

"""The radar's polar grid: sectors survive the way there and back, and older scans land where the world stands."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.rig.radar_grid import (
    CHANNELS,
    RANGE_STEP_M,
    SHAPE,
    Scan,
    ScanMemory,
    cell_centres,
    scan_features,
    sector_mask,
    sector_of,
)


def scan(xyz, *, seconds=0.0, motion=None, velocity=None, yaw_rate=None, drive=0, power=None):
    points = np.asarray(xyz, np.float32).reshape(-1, 3)
    moves = np.zeros(len(points), np.uint8) if motion is None else np.asarray(motion, np.uint8)
    rest = np.zeros(len(points), np.float32)
    stamp_ns = round(seconds * 1e9)
    return Scan(stamp_ns, drive, points, power, rest, moves, True, velocity, yaw_rate)


def channel(features, name):
    return features[CHANNELS.index(name)]


def test_a_doubtful_cell_does_not_end_the_road_and_a_doubtful_look_behind_the_wall_does_not_reopen_it():
    probability = np.full(SHAPE, 0.1)
    probability[:, :20] = 0.9
    probability[:, 5] = 0.3
    probability[:, 40] = 0.8
    azimuth, range_m = sector_of(probability)
    assert len(azimuth) == SHAPE[0]
    assert np.all(range_m == 20 * RANGE_STEP_M)


@given(st.integers(0, SHAPE[0] - 1), st.integers(2, SHAPE[1] - 1), st.sampled_from([0, 1, 2]))
def test_a_detection_lies_in_the_cell_around_it_and_in_the_channel_of_its_motion(a, r, motion):
    azimuth, ranges = cell_centres()
    point = [ranges[r] * np.cos(azimuth[a]), ranges[r] * np.sin(azimuth[a]), 0]
    features = scan_features(scan([point], motion=[motion]), [])
    for m, name in enumerate(("static", "moving", "undecided")):
        expected = np.zeros(SHAPE)
        expected[a, r] = np.log(2) if m == motion else 0
        np.testing.assert_allclose(channel(features, name), expected, atol=1e-6)
    until = channel(features, "static_until")[a]
    assert np.array_equal(until > 0, (np.arange(SHAPE[1]) >= r) & (motion == 0))


@pytest.mark.parametrize("yaw_rate", [0.0, 0.4, -0.4])
def test_static_points_of_an_older_scan_land_on_those_of_the_new_one(yaw_rate):
    world = np.stack([np.linspace(12, 45, 40), np.full(40, 6.3), np.zeros(40)], -1)
    speed, dt = 10.0, 0.2
    turn = yaw_rate * dt
    where = (
        np.array([speed * dt, 0])
        if turn == 0
        else speed / yaw_rate * np.array([np.sin(turn), 1 - np.cos(turn)])
    )
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    now = np.column_stack([(world[:, :2] - where) @ R, np.zeros(40)])  # p_new = R^T (p_old - t)
    memory = ScanMemory()
    memory.features(scan(world, velocity=(speed, 0.0), yaw_rate=yaw_rate))
    found = memory.features(scan(now, seconds=dt, velocity=(speed, 0.0), yaw_rate=yaw_rate))
    same = (channel(found, "recent_static") > 0) == (channel(found, "static") > 0)
    assert same.all() or np.sum(~same) <= 4  # points on the very edge of a cell
    assert (channel(found, "recent_static") > 0).sum() > 25


def test_scans_of_another_drive_too_old_or_of_unknown_motion_are_not_carried_along():
    points = [[20, 0, 0], [30, 2, 0]]
    for first, second in (
        ({"drive": 0, "velocity": (5.0, 0.0)}, {"drive": 1, "velocity": (5.0, 0.0), "seconds": 0.1}),
        ({"velocity": (5.0, 0.0)}, {"velocity": (5.0, 0.0), "seconds": 2.0}),
        ({"velocity": None}, {"velocity": (5.0, 0.0), "seconds": 0.1}),
    ):
        memory = ScanMemory()
        memory.features(scan(points, **first))
        assert not channel(memory.features(scan(points, **second)), "recent_static").any()


def test_power_is_relative_to_the_scan_so_that_units_do_not_matter():
    points = [[10, 0, 0], [20, 0, 0], [30, 0, 0]]
    power = np.array([1, 5, 9], np.float32)
    one = scan_features(scan(points, power=power), [])
    other = scan_features(scan(points, power=power - 70), [])
    assert channel(one, "power") == pytest.approx(channel(other, "power"), abs=1e-5)
    assert channel(one, "power").max() == pytest.approx(0.4)


@given(st.lists(st.integers(0, SHAPE[1]), min_size=SHAPE[0], max_size=SHAPE[0]))
def test_a_mask_that_is_a_free_sector_survives_the_way_through_azimuths_and_ranges(cuts):
    mask = np.arange(SHAPE[1]) < np.array(cuts)[:, None]
    assert np.array_equal(sector_mask(*sector_of(mask.astype(float))), mask)

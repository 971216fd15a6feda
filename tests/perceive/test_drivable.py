"""The radar's free sector."""

import numpy as np

from pipeline.perceive.drivable import free_sector

STATIC, MOVING = 0, 1


def corridor(rng, half_width=6.0, length=50.0, points=900):
    """Returns of two rails beside the road."""
    x = rng.uniform(3, length, points)
    y = np.where(np.arange(points) % 2 == 0, half_width, -half_width) + rng.normal(0, 0.1, points)
    return np.stack([x, y, rng.normal(0, 0.3, points)], 1).astype(np.float32)


def expected(azimuth, half_width=6.0):
    return half_width / np.abs(np.sin(azimuth))


def test_a_corridor_is_free_up_to_its_rails():
    points = corridor(np.random.default_rng(0))
    sector = free_sector(points, np.zeros(len(points), np.uint8), has_elevation=True)
    wide = np.abs(sector.azimuth_rad) > np.radians(12)
    ratio = sector.range_m[wide] / expected(sector.azimuth_rad[wide])
    assert wide.sum() > 40
    assert np.median(ratio) > 0.9
    assert np.median(ratio) < 1.02
    assert np.all(np.diff(sector.azimuth_rad) > 0)


def test_moving_and_lonely_returns_do_not_end_the_road():
    rng = np.random.default_rng(1)
    rails = corridor(rng)
    car = rng.normal([12, 0, 0], 0.3, (30, 3))
    clutter = np.array([[8.0, 3.0, 0.0], [9.0, -2.0, 0.2]])
    points = np.concatenate([rails, car, clutter]).astype(np.float32)
    motion = np.concatenate([np.zeros(len(rails)), np.full(30, MOVING), [STATIC, STATIC]]).astype(np.uint8)
    with_car = free_sector(points, motion, has_elevation=True)
    without = free_sector(rails, np.zeros(len(rails), np.uint8), has_elevation=True)
    assert np.array_equal(with_car.range_m, without.range_m)


def test_a_parked_car_ends_the_road_before_it():
    rng = np.random.default_rng(2)
    points = np.concatenate([corridor(rng), rng.normal([15, 0, 0], 0.3, (30, 3))]).astype(np.float32)
    sector = free_sector(points, np.zeros(len(points), np.uint8), has_elevation=True)
    ahead = np.abs(sector.azimuth_rad) < np.radians(1.1)
    assert np.all(sector.range_m[ahead] < 15.5)


def test_a_sign_above_the_road_is_no_obstacle_where_elevation_is_measured():
    rng = np.random.default_rng(3)
    rails = corridor(rng)
    points = np.concatenate([rails, rng.normal([20, 0, 5], 0.2, (30, 3))]).astype(np.float32)
    motion = np.zeros(len(points), np.uint8)
    high = free_sector(points, motion, has_elevation=True)
    assert np.all(high.range_m[np.abs(high.azimuth_rad) < np.radians(1.1)] > 22)
    flat = free_sector(points * np.array([1, 1, 0], np.float32), motion, has_elevation=False)
    assert np.all(flat.range_m[np.abs(flat.azimuth_rad) < np.radians(1.1)] < 21)


def test_directions_without_evidence_are_absent():
    rng = np.random.default_rng(4)
    left = rng.normal([10, 6, 0], 0.4, (50, 3))
    right = rng.normal([10, -6, 0], 0.4, (50, 3))
    points = np.concatenate([left, right]).astype(np.float32)
    sector = free_sector(points, np.zeros(100, np.uint8), has_elevation=True)
    assert np.min(np.abs(sector.azimuth_rad)) > np.radians(15)
    nothing = free_sector(np.zeros((0, 3), np.float32), np.zeros(0, np.uint8), has_elevation=False)
    assert nothing.azimuth_rad.shape == nothing.range_m.shape == (0,)

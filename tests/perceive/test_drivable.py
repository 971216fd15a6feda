"""The radar's free sector."""

import numpy as np

from pipeline.perceive.drivable import free_sector

MOVING = 1


def corridor(half_width=6.0, points=900):
    """Returns of two rails beside the road."""
    rng = np.random.default_rng(0)
    y = np.where(np.arange(points) % 2 == 0, half_width, -half_width) + rng.normal(0, 0.1, points)
    return np.stack([rng.uniform(3, 50, points), y, rng.normal(0, 0.3, points)], 1).astype(np.float32)


def blob(centre, count=30):
    return np.random.default_rng(1).normal(centre, 0.3, (count, 3)).astype(np.float32)


def sector(*parts, moving=0, has_elevation=True):
    """The free sector of static returns, of which the last ones move."""
    points = np.concatenate(parts)
    motion = np.zeros(len(points), np.uint8)
    motion[len(points) - moving :] = MOVING
    return free_sector(points, motion, has_elevation=has_elevation)


def ahead(found):
    return found.range_m[np.abs(found.azimuth_rad) < np.radians(1.1)]


def test_a_corridor_is_free_up_to_its_rails():
    found = sector(corridor())
    wide = np.abs(found.azimuth_rad) > np.radians(12)
    ratio = found.range_m[wide] * np.abs(np.sin(found.azimuth_rad[wide])) / 6.0
    assert wide.sum() > 40
    assert 0.9 < np.median(ratio) < 1.02
    assert np.all(np.diff(found.azimuth_rad) > 0)


def test_moving_and_lonely_returns_do_not_end_the_road_and_a_parked_car_does():
    rails, car = corridor(), blob([15, 0, 0])
    clutter = np.array([[8.0, 3.0, 0.0], [9.0, -2.0, 0.2]], np.float32)
    np.testing.assert_array_equal(sector(rails, clutter, car, moving=30).range_m, sector(rails).range_m)
    assert np.all(ahead(sector(rails, car)) < 15.5)


def test_a_sign_above_the_road_is_no_obstacle_where_elevation_is_measured():
    seen = np.concatenate([corridor(), blob([20, 0, 5])])
    assert np.all(ahead(sector(seen)) > 22)
    assert np.all(ahead(sector(seen * np.array([1, 1, 0], np.float32), has_elevation=False)) < 21)

"""The ground where a model says what lidar points are, and where it says nothing."""

import numpy as np
import pytest

from pipeline.perceive.ground import PointKind, find_ground, height_over


def street(rng, count=30000):
    """A road of |y| < 4 m, sidewalks level with it to 8 m, and a low flat-bed trailer's side on the road."""
    x, y = rng.uniform(-30, 30, count), rng.uniform(-8, 8, count)
    # Smooth: RANSAC takes the lowest point of each cell, and so lies some sigmas of roughness low.
    road = np.column_stack([x, y, rng.normal(-1.7, 0.003, count)])
    trailer = rng.uniform([12.0, -1.0, -1.68], [12.4, 1.0, -1.45], (600, 3))
    points = np.concatenate([road, trailer]).astype(np.float32)
    kind = np.where(np.abs(points[:, 1]) < 4, PointKind.ROAD, PointKind.FLAT).astype(np.uint8)
    kind[count:] = PointKind.ROAD_USER
    return points, kind


def test_the_drivable_area_ends_where_the_models_road_does():
    rng = np.random.default_rng(7)
    points, kind = street(rng)
    plain, told = (find_ground(points, 0.15, np.random.default_rng(0), k) for k in (None, kind))
    assert np.abs(plain.drivable_xyz_m[:, 1]).max() > 7  # geometry cannot tell a level sidewalk
    assert np.abs(told.drivable_xyz_m[:, 1]).max() <= 4
    seen = np.hypot(points[:, 0], points[:, 1]) > 2.6
    assert np.mean(told.is_ground[(kind == PointKind.FLAT) & seen]) > 0.99
    assert not (told.is_road & ~(told.is_ground & (kind == PointKind.ROAD))).any()
    assert np.mean(told.is_road[(kind == PointKind.ROAD) & seen]) > 0.99
    assert told.plane[3] == pytest.approx(1.7, abs=0.01)


def test_road_users_are_no_ground_and_block_however_low_they_are():
    rng = np.random.default_rng(8)
    points, kind = street(rng)
    plain, told = (find_ground(points, 0.15, np.random.default_rng(0), k) for k in (None, kind))
    user = kind == PointKind.ROAD_USER
    assert np.mean(plain.is_ground[user]) > 0.5
    assert not told.is_ground[user].any()
    behind = lambda found: np.sum((found[:, 0] > 14) & (np.abs(found[:, 1]) < 1))  # noqa: E731
    assert behind(plain.drivable_xyz_m) > 20
    assert behind(told.drivable_xyz_m) == 0


def test_ransac_drops_what_the_model_took_for_road():
    rng = np.random.default_rng(9)
    points, kind = street(rng)
    wall = rng.uniform([5, 3.0, -1.0], [25, 3.4, 1.0], (4000, 3)).astype(np.float32)
    points = np.concatenate([points, wall])
    kind = np.append(kind, np.full(4000, PointKind.ROAD, np.uint8))
    found = find_ground(points, 0.15, np.random.default_rng(0), kind)
    assert found.plane[3] == pytest.approx(1.7, abs=0.02)
    assert found.plane[2] > np.cos(np.radians(0.5))
    assert not (found.is_ground | found.is_road)[-4000:].any()


def test_geometry_decides_on_points_that_the_model_does_not_know():
    rng = np.random.default_rng(10)
    points, kind = street(rng)
    far = np.abs(points[:, 1]) > 6
    kind[far] = PointKind.UNKNOWN
    found = find_ground(points, 0.15, np.random.default_rng(0), kind)
    assert np.mean(found.is_ground[far]) > 0.95
    assert not found.is_road[far].any()
    assert np.abs(height_over(found.plane, points[far])).max() < 0.2


def test_the_surface_does_not_climb_what_the_model_knows_for_an_object():
    points, kind = street(np.random.default_rng(12))
    hedge = (points[:, 0] > 10) & (points[:, 0] < 20)  # rises like a hill, across the whole street
    points[hedge, 2] += 0.05 * (points[hedge, 0] - 10)
    kind[hedge] = PointKind.OTHER
    beyond = (points[:, 0] > 20) & (points[:, 0] < 26) & (np.abs(points[:, 1]) < 4)
    plain, told = (find_ground(points, 0.15, np.random.default_rng(0), k) for k in (None, kind))
    assert np.mean(plain.is_ground[hedge]) > 0.5
    assert not told.is_ground[hedge].any()
    assert np.mean(plain.is_ground[beyond]) < 0.5
    assert np.mean(told.is_ground[beyond]) > 0.99


def test_too_little_road_gives_no_plane_and_no_drivable_area_but_keeps_the_models_ground():
    points, kind = street(np.random.default_rng(11))
    kind[kind == PointKind.ROAD] = PointKind.OTHER
    found = find_ground(points, 0.15, np.random.default_rng(0), kind)
    assert found.plane is None
    assert len(found.drivable_xyz_m) == 0
    seen = np.hypot(points[:, 0], points[:, 1]) > 2.6
    assert np.array_equal(found.is_ground[seen], kind[seen] == PointKind.FLAT)

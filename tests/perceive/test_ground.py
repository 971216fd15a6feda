"""The ground: recovered on slopes, between walls and cars, and refused where there is none."""

import numpy as np
import pytest

from pipeline.perceive.ground import find_ground, height_over


def sweep(rng, *, tilt=(0.0, 0.0), height=1.7, beams=32, walls=True, cars=0, noise=0.02):
    """Rays of a lidar against a road and what stands on it: points, which are ground, the plane."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(0, 360, 0.5)), np.radians(np.linspace(-22, 8, beams))
    )
    rays = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1
    )
    rays = rays.reshape(-1, 3)
    normal = np.array([-np.tan(tilt[0]), -np.tan(tilt[1]), 1.0])
    normal /= np.linalg.norm(normal)
    with np.errstate(divide="ignore"):
        to_ground = -height / (rays @ normal)
        to_ground[(to_ground < 0) | (to_ground > 60)] = np.inf
        to_wall = np.where(rays[:, 1] > 0, 9.0, -7.0) / rays[:, 1] if walls else np.full(len(rays), np.inf)
    distance = np.minimum(to_ground, to_wall)
    is_ground = to_ground <= to_wall
    for k in range(cars):
        low, high = np.array([5.0 + 6 * k, -4.0, -height]), np.array([9.5 + 6 * k, -2.2, -height + 1.5])
        with np.errstate(divide="ignore", invalid="ignore"):
            near, far = np.sort([low / rays, high / rays], axis=0)
        enter, leave = near.max(axis=1), far.min(axis=1)
        hit = (enter < leave) & (enter > 0) & (enter < distance)
        distance, is_ground = np.where(hit, enter, distance), is_ground & ~hit
    seen = np.isfinite(distance) & (distance < 100)
    points = rays[seen] * (distance[seen] + rng.normal(0, noise, seen.sum()))[:, None]
    return points.astype(np.float32), is_ground[seen], np.append(normal, height)


def angle_deg(a, b):
    return np.degrees(np.arccos(np.clip(a[:3] @ b[:3], -1, 1)))


@pytest.mark.parametrize("tilt_deg", [(0, 0), (3, 0), (-4, 2), (0, -8), (10, 0)])
@pytest.mark.parametrize("height", [0.5, 1.7, 3.2])
def test_the_plane_of_a_tilted_road_between_walls_is_recovered(tilt_deg, height):
    rng = np.random.default_rng(0)
    points, _, truth = sweep(rng, tilt=np.radians(tilt_deg), height=height)
    plane = find_ground(points, 0.15, rng).plane
    assert angle_deg(plane, truth) < 0.4
    assert plane[3] == pytest.approx(height, abs=0.05)


@pytest.mark.parametrize("beams", [16, 32, 64])
def test_ground_points_are_told_from_walls_and_cars(beams):
    rng = np.random.default_rng(1)
    points, truth, plane = sweep(rng, beams=beams, cars=5, tilt=(0.02, -0.01))
    found = find_ground(points, 0.15, rng).is_ground
    near = np.hypot(points[:, 0], points[:, 1]) > 2.6
    assert np.mean(found[truth & near]) > 0.95
    clear = height_over(plane, points) > 0.4  # the foot of a wall is ground to a lidar
    assert np.mean(found[~truth & clear & near]) < 0.01


def test_every_seed_finds_the_same_ground():
    points, _, _ = sweep(np.random.default_rng(2), cars=6)
    planes = np.array([find_ground(points, 0.15, np.random.default_rng(s)).plane for s in range(12)])
    assert np.ptp(planes[:, 3]) < 0.02
    assert np.max(np.ptp(planes[:, :3], axis=0)) < 0.005


def spread(rng, low, high, count):
    return rng.uniform(low, high, (count, 3))


@pytest.mark.parametrize("seed", range(4))
def test_a_road_between_deep_ditches_is_the_ground_and_not_the_ditches(seed):
    # Real case: crowned asphalt, 0.8 m lower on both sides over much more area than the road has.
    rng = np.random.default_rng(seed)
    road = spread(rng, [-30, -3.5, -1.72], [30, 3.5, -1.68], 2500)
    ditches = [
        spread(rng, [-30, 5, -2.55], [30, 15, -2.45], 4000),
        spread(rng, [-30, -15, -2.55], [30, -5, -2.45], 4000),
    ]
    plane = find_ground(np.concatenate([road, *ditches]).astype(np.float32), 0.15, rng).plane
    assert plane[3] == pytest.approx(1.7, abs=0.06)


@pytest.mark.parametrize("seed", range(4))
def test_a_lane_between_parked_cars_is_the_ground_and_not_their_bonnets(seed):
    # Real case: a car park, where a tenth of the cells show asphalt and the lowest points of the rest are cars.
    rng = np.random.default_rng(seed)
    lane = spread(rng, [3, -2.5, -1.72], [18, 2.5, -1.68], 1500)
    bonnets, fronts = [], []
    for side in (-1, 1):
        for x in np.arange(-20, 30, 2.6):
            high = rng.uniform(-1.1, -0.4)  # no two cars have bonnets of one height
            bonnets.append(spread(rng, [x, 3.0, high - 0.05], [x + 1.8, 7.5, high + 0.05], 60) * [1, side, 1])
            fronts.append(spread(rng, [x, 3.0, -1.65], [x + 1.8, 3.05, -0.8], 60) * [1, side, 1])
    ground = find_ground(np.concatenate([lane, *bonnets, *fronts]).astype(np.float32), 0.15, rng)
    assert ground.plane[3] == pytest.approx(1.7, abs=0.06)
    assert ground.is_ground[: len(lane)].mean() > 0.9
    assert ground.is_ground[len(lane) :][: 60 * len(bonnets)].mean() < 0.05


def test_a_rising_road_is_followed_beyond_the_plane():
    # 5 % steeper from 20 m on: 1 m over the plane at 40 m.
    rng = np.random.default_rng(3)
    ring, azimuth = np.meshgrid(np.geomspace(4, 45, 40), np.radians(np.arange(-60, 60, 0.5)))
    x, y = (ring * np.cos(azimuth)).ravel(), (ring * np.sin(azimuth)).ravel()
    z = -1.7 + 0.05 * np.clip(np.hypot(x, y) - 20, 0, None) + rng.normal(0, 0.02, len(x))
    found = find_ground(np.stack([x, y, z], 1).astype(np.float32), 0.15, rng).is_ground
    assert np.mean(found) > 0.95


def test_what_lies_behind_an_obstacle_is_not_drivable():
    rng = np.random.default_rng(4)
    points, _, _ = sweep(rng, cars=0, walls=False)
    direction = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    fence = [
        [10 * np.cos(a), 10 * np.sin(a), z]
        for a in np.radians(np.arange(20, 40, 0.2))
        for z in (-1.2, -0.8, -0.3)
    ]
    drivable = find_ground(np.concatenate([points, np.array(fence, np.float32)]), 0.15, rng).drivable_xyz_m
    behind = (np.hypot(drivable[:, 0], drivable[:, 1]) > 11.5) & (
        np.abs(np.degrees(np.arctan2(drivable[:, 1], drivable[:, 0])) - 30) < 8
    )
    assert not behind.any()
    beside = np.abs(np.degrees(np.arctan2(drivable[:, 1], drivable[:, 0])) + 30) < 8
    assert (np.hypot(drivable[beside, 0], drivable[beside, 1]) > 11.5).any()
    assert np.ptp(direction) > 300


def test_drivable_cells_are_one_metre_apart_and_on_the_ground():
    rng = np.random.default_rng(5)
    points, _, truth = sweep(rng, tilt=(0.03, 0.0))
    drivable = find_ground(points, 0.15, rng).drivable_xyz_m
    cells = np.floor(drivable[:, :2])
    assert len(np.unique(cells, axis=0)) == len(cells)
    assert np.max(np.abs(height_over(truth, drivable))) < 0.3


@pytest.mark.parametrize("kind", ["nothing", "wall", "ceiling"])
def test_no_ground_is_said_to_be_none(kind):
    rng = np.random.default_rng(6)
    points = rng.uniform([3, -20, -1], [3.1, 20, 8], (4000, 3))
    if kind == "nothing":
        points = points[:20]
    if kind == "ceiling":
        points = rng.uniform([-20, -20, 2.5], [20, 20, 2.55], (4000, 3))
    ground = find_ground(points.astype(np.float32), 0.15, rng)
    assert ground.plane is None
    assert not ground.is_ground.any()
    assert ground.drivable_xyz_m.shape == (0, 3)

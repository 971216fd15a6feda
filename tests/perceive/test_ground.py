"""The ground: on slopes, between walls and cars, by a model's word, on real sweeps; and refused where there is none."""

from itertools import islice

import numpy as np
import pytest

from pipeline.perceive.ground import PointKind, find_ground, height_over


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


def spread(rng, low, high, count):
    return rng.uniform(low, high, (count, 3))


def ground_of(points, kind=None, seed=0):
    return find_ground(np.asarray(points, np.float32), 0.15, np.random.default_rng(seed), kind)


@pytest.mark.parametrize("tilt_deg", [(0, 0), (3, 0), (-4, 2), (0, -8), (10, 0)])
@pytest.mark.parametrize("height", [0.5, 1.7, 3.2])
def test_the_plane_of_a_tilted_road_between_walls_is_recovered(tilt_deg, height):
    points, _, truth = sweep(np.random.default_rng(0), tilt=np.radians(tilt_deg), height=height)
    plane = ground_of(points).plane
    assert np.degrees(np.arccos(np.clip(plane[:3] @ truth[:3], -1, 1))) < 0.4
    assert plane[3] == pytest.approx(height, abs=0.05)


@pytest.mark.parametrize("beams", [16, 32, 64])
def test_ground_points_are_told_from_walls_and_cars(beams):
    points, truth, plane = sweep(np.random.default_rng(1), beams=beams, cars=5, tilt=(0.02, -0.01))
    found = ground_of(points)
    near = np.hypot(points[:, 0], points[:, 1]) > 2.6
    assert np.mean(found.is_ground[truth & near]) > 0.95
    clear = height_over(plane, points) > 0.4  # the foot of a wall is ground to a lidar
    assert np.mean(found.is_ground[~truth & clear & near]) < 0.01
    cells = np.floor(found.drivable_xyz_m[:, :2])
    assert len(np.unique(cells, axis=0)) == len(cells)  # one metre apart
    assert np.max(np.abs(height_over(plane, found.drivable_xyz_m))) < 0.3


@pytest.mark.parametrize("seed", range(4))
def test_a_road_between_deep_ditches_is_the_ground_and_not_the_ditches(seed):
    # Real case: crowned asphalt, 0.8 m lower on both sides over much more area than the road has.
    rng = np.random.default_rng(seed)
    road = spread(rng, [-30, -3.5, -1.72], [30, 3.5, -1.68], 2500)
    ditches = [spread(rng, [-30, y, -2.55], [30, y + 10, -2.45], 4000) for y in (5, -15)]
    assert ground_of(np.concatenate([road, *ditches])).plane[3] == pytest.approx(1.7, abs=0.06)


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
    ground = ground_of(np.concatenate([lane, *bonnets, *fronts]))
    assert ground.plane[3] == pytest.approx(1.7, abs=0.06)
    assert ground.is_ground[: len(lane)].mean() > 0.9
    assert ground.is_ground[len(lane) :][: 60 * len(bonnets)].mean() < 0.05


@pytest.mark.parametrize(
    ("low", "high", "count"),
    [([3, -20, -1], [3.1, 20, 8], 20), ([3, -20, -1], [3.1, 20, 8], 4000), ([-20, -20, 2.5], [20, 20, 2.55], 4000)],
    ids=["nothing", "wall", "ceiling"],
)  # fmt: skip
def test_no_ground_is_said_to_be_none(low, high, count):
    ground = ground_of(spread(np.random.default_rng(6), low, high, count))
    assert ground.plane is None
    assert not ground.is_ground.any()
    assert ground.drivable_xyz_m.shape == (0, 3)


# Where a model says what points are.


@pytest.fixture
def street():
    """A road of |y| < 4 m, sidewalks level with it to 8 m, a low flat-bed trailer's side on it; points and kinds."""
    rng, count = np.random.default_rng(7), 30_000
    x, y = rng.uniform(-30, 30, count), rng.uniform(-8, 8, count)
    # Smooth: RANSAC takes the lowest point of each cell, and so lies some sigmas of roughness low.
    road = np.column_stack([x, y, rng.normal(-1.7, 0.003, count)])
    points = np.concatenate([road, spread(rng, [12.0, -1.0, -1.68], [12.4, 1.0, -1.45], 600)])
    kind = np.where(np.abs(points[:, 1]) < 4, PointKind.ROAD, PointKind.FLAT).astype(np.uint8)
    kind[count:] = PointKind.ROAD_USER
    return points.astype(np.float32), kind


def test_the_drivable_area_ends_where_the_models_road_does_and_road_users_block_however_low(street):
    points, kind = street
    plain, told = ground_of(points), ground_of(points, kind)
    assert np.abs(plain.drivable_xyz_m[:, 1]).max() > 7  # geometry cannot tell a level sidewalk
    assert np.abs(told.drivable_xyz_m[:, 1]).max() <= 4
    seen, user = np.hypot(points[:, 0], points[:, 1]) > 2.6, kind == PointKind.ROAD_USER
    assert np.mean(told.is_ground[(kind == PointKind.FLAT) & seen]) > 0.99
    assert not (told.is_road & ~(told.is_ground & (kind == PointKind.ROAD))).any()
    assert np.mean(told.is_road[(kind == PointKind.ROAD) & seen]) > 0.99
    assert told.plane[3] == pytest.approx(1.7, abs=0.01)
    assert np.mean(plain.is_ground[user]) > 0.5
    assert not told.is_ground[user].any()
    behind = lambda found: np.sum((found[:, 0] > 14) & (np.abs(found[:, 1]) < 1))  # noqa: E731
    assert behind(plain.drivable_xyz_m) > 20
    assert behind(told.drivable_xyz_m) == 0


def real_sweeps(log):
    """Points of every second sweep of one log; a car park and a road between ditches are among them."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, _, _, cloud in islice(reader.iter_decoded_messages(["/lidar/top/points"]), 1, None, 2):
            raw = np.frombuffer(bytes(cloud.data), np.uint8).reshape(-1, cloud.point_step)
            yield raw[:, :12].copy().view("<f4")  # x y z come first, float32


@pytest.mark.real_logs
def test_the_lidars_height_over_a_real_road_is_the_same_in_every_sweep(real_logs):
    logs = [real_logs / f"astyx-1_2019-01-14_0{k}.mcap" for k in range(2)]
    points = [points for log in logs for points in real_sweeps(log)]
    planes = np.array([[ground_of(p, seed=s).plane for s in range(2)] for p in points])
    assert len(planes) == 46
    heights = planes[:, :, 3]
    assert np.ptp(heights, axis=1).max() < 0.05
    # The road's own crown and slope, and the vehicle's load, are in this spread; measured 1.63 .. 1.82 m.
    assert np.max(np.abs(heights[:, 0] - np.median(heights[:, 0]))) < 0.15
    assert np.degrees(np.arccos(planes[:, 0, 2])).max() < 4.5

"""Odometry, Doppler and the lidar's sweeps against each other: the one that is wrong is named, and by what."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.verify.motion_sources import compared_sources, sweep_motion
from pipeline.rig.se3 import changed, inverse, transform_points
from schemas.calibrations import PAIRS
from tests.makers.solve_scenes import T_LIDAR_RADAR, make_day

STEP_S = 0.5


def driven(frames=36, seed=5, turn_radps=0.12):
    """A car that speeds up, brakes and turns among posts and walls, as all three sources show it."""
    rng = np.random.default_rng(seed)
    posts = rng.uniform([-60, -200], [420, 200], size=(1500, 2))
    time = np.arange(frames) * STEP_S
    fine = np.arange(0, frames * STEP_S + 1, 0.01)
    speed = 9 + 4 * np.sin(0.7 * fine)
    rate = turn_radps * np.sin(0.4 * fine)
    yaw = np.cumsum(rate) * 0.01
    at = np.cumsum(np.stack([speed * np.cos(yaw), speed * np.sin(yaw)], 1), axis=0) * 0.01
    day = []
    for k, o in enumerate(make_day(frames, per_drive=frames, step_s=STEP_S)):
        i = round(time[k] * 100)
        c, s = np.cos(yaw[i]), np.sin(yaw[i])
        seen = (posts - at[i]) @ np.array([[c, -s], [s, c]])
        seen = seen[np.hypot(*seen.T) < 55] + rng.normal(0, 0.03, size=(np.sum(np.hypot(*seen.T) < 55), 2))
        cloud = np.column_stack([seen, np.zeros(len(seen))])
        ahead = cloud[cloud[:, 0] > 3][:120]
        day.append(replace(
            o, lidar_map_xyz_m=cloud.astype(np.float32), lidar_map_is_ground=np.zeros(len(cloud), np.uint8),
            ego_speed_mps=float(speed[i]), ego_yaw_rate_radps=float(rate[i]),
            radar_velocity_mps=T_LIDAR_RADAR[:3, :3].T @ [speed[i], 0.0, 0.0] + rng.normal(0, 0.05, 3),
            radar_xyz_m=transform_points(inverse(T_LIDAR_RADAR), ahead).astype(np.float32),
            radar_motion=np.zeros(len(ahead), np.uint8),
        ))  # fmt: skip
    return day


@pytest.fixture(scope="module")
def day():
    return driven()


def with_odometry(day, speed=1.0, turn=1.0):
    return [
        replace(o, ego_speed_mps=speed * o.ego_speed_mps, ego_yaw_rate_radps=turn * o.ego_yaw_rate_radps)
        for o in day
    ]


def with_doppler(day, factor):
    return [replace(o, radar_velocity_mps=factor * o.radar_velocity_mps) for o in day]


def without_odometry(day):
    return [replace(o, ego_speed_mps=None, ego_yaw_rate_radps=None) for o in day]


def without_lidar(day):
    return [replace(o, lidar_map_is_ground=np.ones_like(o.lidar_map_is_ground)) for o in day]


def late(day, lag_s):
    stamps, speeds = np.arange(len(day)) * STEP_S, [o.ego_speed_mps for o in day]
    return [
        replace(o, ego_speed_mps=float(np.interp(t - lag_s, stamps, speeds)))
        for o, t in zip(day, stamps, strict=True)
    ]


def told(day, T=T_LIDAR_RADAR):
    """Fault and sentence of each finding."""
    return [(check.fault, check.sentence) for check in compared_sources(day, T).wrong]


def test_the_lidar_alone_shows_speed_and_yaw_rate_of_the_car(day):
    pairs, speed_mps, yaw_rate_radps = sweep_motion(day)
    assert len(pairs) >= 25
    speed = np.array([(day[i].ego_speed_mps + day[j].ego_speed_mps) / 2 for i, j in pairs])
    turn = np.array([(day[i].ego_yaw_rate_radps + day[j].ego_yaw_rate_radps) / 2 for i, j in pairs])
    assert np.abs(speed_mps - speed).max() < 0.8
    assert np.abs(yaw_rate_radps - turn).max() < 0.04


def test_sources_that_agree_raise_no_alarm(day):
    for good in (day, without_odometry(day), without_lidar(day), with_odometry(day, 1.05), late(day, 0.05)):
        assert told(good) == []
    numbers = compared_sources(day, T_LIDAR_RADAR).numbers
    assert numbers["motion_odometry_by_doppler"] == pytest.approx(1, abs=0.01)
    assert numbers["motion_yaw_rate_by_lidar"] == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: with_odometry(d, -1), "the other sign fits"),
        (lambda d: with_odometry(d, 2), "its scale is wrong"),
        (lambda d: with_odometry(d, 3.6), "km/h for m/s fits"),
        (lambda d: with_odometry(d, 1, -1), "turns -"),
        (lambda d: with_odometry(d, 1, 180 / np.pi), "deg/s for rad/s fits"),
        (lambda d: without_lidar(with_odometry(d, 2)), "its scale is wrong"),
    ],
)
def test_a_wrong_odometry_is_named_with_what_would_fit(day, change, says):
    (fault, sentence), *_ = told(change(day))
    assert fault == "odometry"
    assert says in sentence


def test_an_odometry_that_lags_is_named_with_the_sign_of_its_lag(day):
    for lag_s, words in ((0.25, "behind the radar's Doppler"), (-0.25, "ahead of the radar's Doppler")):
        [(fault, sentence)] = told(late(day, lag_s))
        assert fault == "odometry"
        assert words in sentence


@pytest.mark.parametrize(
    ("factor", "left"),
    [(-1.0, list), (3.6, list), (-3.6, list), (-1.0, without_odometry), (3.6, without_odometry), (3.6, without_lidar)],
)  # fmt: skip
def test_a_doppler_of_the_wrong_sign_or_unit_is_named(day, factor, left):
    (fault, sentence), *_ = told(left(with_doppler(day, factor)))
    assert fault == "doppler"
    assert ("other sign" in sentence) == (factor < 0)
    assert ("km/h for m/s" in sentence) == (abs(factor) > 2)


def test_a_doppler_that_drives_backwards_all_day_is_named_where_nothing_else_tells(day):
    alone = without_lidar(without_odometry(day))
    assert told(alone) == []
    assert [f for f, _ in told(with_doppler(alone, -1))] == ["doppler"]
    assert told(without_lidar(without_odometry(with_doppler(day, 3.6)))) == []  # nobody can know


def test_a_radar_that_looks_back_is_not_taken_for_a_wrong_sign(day):
    turned = changed(T_LIDAR_RADAR, np.pi * np.eye(6)[2])
    assert [f for f, _ in told(day, turned)] == ["orientation"]


def test_scans_that_no_velocity_explains_are_named(day):
    undecided = [np.full(len(o.radar_xyz_m), 2, np.uint8) for o in day]
    silent = [
        replace(o, radar_velocity_mps=None, radar_motion=m) for o, m in zip(day, undecided, strict=True)
    ]
    assert [f for f, _ in told(silent)] == ["doppler"]
    assert told(day[:20] + silent[20:]) == []


@pytest.mark.parametrize("fits", ["what stands", "chance"])
def test_a_convoy_that_fills_the_scans_is_no_wrong_doppler_and_a_fit_by_chance_is_one(day, fits):
    rng = np.random.default_rng(4)
    filled = []
    for o in day:
        standing = o.radar_xyz_m[:25]
        cars = np.repeat(rng.uniform([10, -8, -1], [60, 8, 1], (10, 3)), 12, axis=0).astype(np.float32)
        own = rng.normal(0, 0.07, len(standing))
        speeds = np.repeat(rng.uniform(-12, -2, 10), 12) + rng.normal(0, 0.1, len(cars))
        if fits == "chance":
            own, speeds = rng.uniform(-0.4, 0.4, len(own)), rng.uniform(0.4, 2.4, len(cars))
        xyz, off = np.concatenate([standing, cars]), np.append(own, speeds).astype(np.float32)
        motion = np.repeat([0, 1], [len(standing), len(cars)]).astype(np.uint8)
        filled.append(replace(o, radar_xyz_m=xyz, radar_motion=motion, radar_residual_mps=off))
    assert max(np.mean(o.radar_motion == 0) for o in filled) < 0.2
    assert [f for f, _ in told(filled)] == ([] if fits == "what stands" else ["doppler"])


@pytest.mark.parametrize("turned_by", [0.0, np.pi])
def test_a_wrong_radar_costs_camera_and_lidar_their_day_only_where_their_motion_rests_on_it(day, turned_by):
    T = changed(T_LIDAR_RADAR, turned_by * np.eye(6)[2])
    wrong = with_doppler(day, -1.0 if turned_by == 0 else 1.0)
    for left, pairs in ((wrong, {"camera_radar", "lidar_radar"}), (without_odometry(wrong), set(PAIRS))):
        found = compared_sources(left, T)
        assert {pair for pair in PAIRS if found.of(pair)} == pairs
    assert all(compared_sources(with_odometry(day, 3.6), T_LIDAR_RADAR).of(pair) for pair in PAIRS)


def test_a_sensor_backwards_or_mirrored_is_named_and_a_radar_costs_only_its_own_pairs(day):
    back, across = np.float32([-1, -1, 1]), np.float32([1, -1, 1])
    for column, turn, pairs in (
        ("lidar_map_xyz_m", back, set(PAIRS)),
        ("lidar_map_xyz_m", across, set(PAIRS)),
        ("radar_xyz_m", across, {"camera_radar", "lidar_radar"}),
    ):
        rows = [replace(o, **{column: getattr(o, column) * turn}) for o in day]
        found = compared_sources(rows, T_LIDAR_RADAR)
        assert [check.fault for check in found.wrong] == ["orientation"]
        assert {pair for pair in PAIRS if found.of(pair)} == pairs

"""The radar's own velocity and what moves: recovery on synthetic scans, ambiguity, faults."""

import numpy as np
import pytest

from pipeline.core.config import PerceiveConfig
from pipeline.perceive.ego_velocity import MOVING, STATIC, UNDECIDED, Travel, radar_motion
from pipeline.perceive.moving import cluster_moving

CONFIG = PerceiveConfig()
PERIOD_MPS = 10.394
AHEAD = Travel(heading_rad=0.0)


def scan(rng, velocity, points=400, noise=0.06, movers=0, fov_deg=55.0):
    """Static points and `movers` cars of 6 detections; returns xyz, range rates, is moving."""
    azimuth = np.radians(rng.uniform(-fov_deg, fov_deg, points))
    elevation = np.radians(rng.normal(0, 4, points))
    r = rng.uniform(4, 70, points)
    xyz = np.stack([r * np.cos(azimuth) * np.cos(elevation), r * np.sin(azimuth), r * np.sin(elevation)], -1)
    over_ground = np.zeros(points)
    for k in range(movers):
        xyz[6 * k : 6 * k + 6] = rng.normal([12 + 9 * k, 6 * (k % 3) - 6, 0], 0.4, (6, 3))
        over_ground[6 * k : 6 * k + 6] = 3.0 + 0.1 * k
    u = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    rate = -u @ velocity + over_ground + rng.normal(0, noise, points)
    return xyz.astype(np.float32), rate.astype(np.float32), over_ground != 0


def wrapped(rate):
    return (rate - PERIOD_MPS * np.round(rate / PERIOD_MPS)).astype(np.float32)


@pytest.mark.parametrize("speed", [0.0, 4.0, 10.394, 17.0, 31.0])
def test_the_true_velocity_is_found_among_all_multiples_of_the_period(speed):
    rng = np.random.default_rng(1)
    truth = np.array([speed, 0.02 * speed, 0.03 * speed])
    xyz, rate, _ = scan(rng, truth, movers=5)
    found = radar_motion(xyz, wrapped(rate), None, PERIOD_MPS, AHEAD, True, CONFIG, rng)
    error = found.velocity_mps - truth
    assert abs(error[0]) < 0.03
    assert abs(error[1]) < 0.05
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diag(found.velocity_cov)) + 0.02)


def test_velocity_errors_agree_with_the_reported_covariance():
    z = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        truth = np.array([9.0, 0.3, 0.2])
        xyz, rate, _ = scan(rng, truth, points=200)
        found = radar_motion(xyz, wrapped(rate), None, PERIOD_MPS, AHEAD, True, CONFIG, rng)
        z.append((found.velocity_mps - truth) / np.sqrt(np.diag(found.velocity_cov)))
    assert np.all(np.std(z, axis=0) < 1.5)
    assert np.all(np.std(z, axis=0) > 0.6)


def test_moving_cars_are_told_from_the_static_world_and_become_one_cluster_each():
    rng = np.random.default_rng(3)
    xyz, rate, moving = scan(rng, np.array([8.0, 0.0, 0.0]), movers=5)
    found = radar_motion(xyz, wrapped(rate), None, PERIOD_MPS, AHEAD, True, CONFIG, rng)
    assert np.mean(found.motion[moving] == MOVING) > 0.95
    assert np.mean(found.motion[~moving] == STATIC) > 0.97
    labels = [set(found.cluster[6 * k : 6 * k + 6]) for k in range(5)]
    assert all(len(group) == 1 for group in labels)
    assert len(set.union(*labels)) == 5


def test_an_unambiguous_radar_without_elevation_gives_the_same_velocity():
    rng = np.random.default_rng(4)
    truth = np.array([22.0, 0.4, 0.0])
    xyz, rate, _ = scan(rng, truth, movers=3)
    xyz[:, 2] = 0
    found = radar_motion(xyz, rate, None, None, AHEAD, False, CONFIG, rng)
    # Flattening directions leaves out the cosine of elevations (4 deg here): 0.25 %.
    assert np.abs(found.velocity_mps[:2] - truth[:2]).max() < 0.12
    assert found.velocity_cov[2, 2] > 0.5


def test_odometry_limits_the_search():
    rng = np.random.default_rng(5)
    # Too narrow to lift the ambiguity.
    xyz, rate, _ = scan(rng, np.array([6.0, 0.0, 0.0]), points=60, fov_deg=4.0)
    for hint in (6.3, 16.0, 27.0):
        found = radar_motion(xyz, wrapped(rate), None, PERIOD_MPS, Travel(hint, 0.0), True, CONFIG, rng)
        assert abs(found.velocity_mps[0] - hint) < 2.5


def test_a_scan_without_static_world_stays_undecided():
    rng = np.random.default_rng(6)
    xyz, _, _ = scan(rng, np.zeros(3))
    noise = rng.uniform(-PERIOD_MPS / 2, PERIOD_MPS / 2, len(xyz)).astype(np.float32)
    found = radar_motion(xyz, noise, None, PERIOD_MPS, AHEAD, True, CONFIG, rng)
    assert found.velocity_mps is None
    assert np.all(found.motion == UNDECIDED)


@pytest.mark.parametrize("points", [0, 1, 5])
def test_too_few_detections_decide_nothing(points):
    found = radar_motion(
        np.ones((points, 3), np.float32),
        np.zeros(points, np.float32),
        None,
        None,
        AHEAD,
        True,
        CONFIG,
        np.random.default_rng(0),
    )
    assert found.velocity_mps is None
    assert len(found.motion) == points


def test_detections_that_are_not_numbers_are_undecided_and_harm_nothing():
    rng = np.random.default_rng(7)
    xyz, rate, _ = scan(rng, np.array([5.0, 0.0, 0.0]))
    xyz[::7] = np.nan
    rate[3::50] = np.inf
    found = radar_motion(xyz, rate, np.full(len(xyz), np.nan, np.float32), None, AHEAD, True, CONFIG, rng)
    assert abs(found.velocity_mps[0] - 5.0) < 0.05
    assert np.all(found.motion[::7] == UNDECIDED)
    assert np.isfinite(found.residual_mps).all()


def test_the_same_seed_gives_the_same_result():
    xyz, rate, _ = scan(np.random.default_rng(8), np.array([12.0, 0.1, 0.0]), points=900, movers=4)
    a, b = (
        radar_motion(xyz, wrapped(rate), None, PERIOD_MPS, AHEAD, True, CONFIG, np.random.default_rng(1))
        for _ in range(2)
    )
    assert np.array_equal(a.velocity_mps, b.velocity_mps)
    assert np.array_equal(a.cluster, b.cluster)


def test_clusters_join_across_the_wrap_of_the_doppler():
    xyz = np.array([[20, 0, 0], [20.2, 0, 0], [20.4, 0, 0]], np.float32)
    rate = np.array([5.1, -5.1, 5.0])
    everything = np.ones(3, bool)
    assert len(set(cluster_moving(xyz, rate, everything, PERIOD_MPS, 1.8))) == 1
    assert len(set(cluster_moving(xyz, rate, everything, 0.0, 1.8))) == 2


def test_odometry_finds_the_static_world_beside_a_bus_that_fills_the_scan():
    rng = np.random.default_rng(12)
    xyz, rate, _ = scan(rng, np.array([11.0, 0.0, 0.0]), points=80)
    bus = rng.uniform([4, 3, -1], [14, 4, 1], (260, 3))
    u = bus / np.linalg.norm(bus, axis=1, keepdims=True)
    bus_rate = -u @ [11.0, 0.0, 0.0] - 12.0 * u[:, 0]
    xyz = np.concatenate([xyz, bus]).astype(np.float32)
    rate = np.concatenate([rate, bus_rate]).astype(np.float32)
    found = radar_motion(xyz, rate, None, 40.0, Travel(10.6, 0.0), True, CONFIG, rng)
    assert found.velocity_mps[0] == pytest.approx(11.0, abs=0.1)
    assert np.mean(found.motion[:80] == STATIC) > 0.9
    assert np.mean(found.motion[80:] == MOVING) > 0.9


MOUNTINGS_DEG = (45.0, -45.0, 90.0, 180.0)


@pytest.mark.parametrize("mounted_deg", MOUNTINGS_DEG)
@pytest.mark.parametrize("period", [None, PERIOD_MPS])
@pytest.mark.parametrize("speed", [3.0, 12.0, 30.0])
def test_a_radar_that_looks_aside_or_back_finds_its_velocity(mounted_deg, period, speed):
    rng = np.random.default_rng(21)
    # The bracket is 3 deg off what the prior says.
    angle = -np.radians(mounted_deg + 3.0)
    truth = speed * np.array([np.cos(angle), np.sin(angle), 0.02])
    xyz, rate, _ = scan(rng, truth, movers=4)
    rate = rate if period is None else wrapped(rate)
    travel = Travel(heading_rad=-np.radians(mounted_deg))
    found = radar_motion(xyz, rate, None, period, travel, True, CONFIG, rng)
    assert np.abs(found.velocity_mps - truth)[:2].max() < 0.06
    assert np.mean(found.motion == STATIC) > 0.9


@pytest.mark.parametrize("mounted_deg", [0.0, *MOUNTINGS_DEG])
def test_an_unknown_mounting_is_found_from_the_scan(mounted_deg):
    rng = np.random.default_rng(22)
    truth = 14.0 * np.array([np.cos(np.radians(mounted_deg)), np.sin(np.radians(mounted_deg)), 0.0])
    xyz, rate, _ = scan(rng, truth, movers=4)
    for rates, period in ((rate, None), (wrapped(rate), PERIOD_MPS)):
        found = radar_motion(xyz, rates, None, period, Travel(), True, CONFIG, rng)
        assert np.abs(found.velocity_mps - truth)[:2].max() < 0.06


@pytest.mark.parametrize("speed", [12.0, 22.0, 33.0])
def test_a_radar_knocked_by_12_deg_against_its_prior_still_finds_its_velocity(speed):
    rng = np.random.default_rng(23)
    truth = speed * np.array([np.cos(np.radians(12)), np.sin(np.radians(12)), 0.0])
    xyz, rate, _ = scan(rng, truth, movers=3)
    found = radar_motion(xyz, wrapped(rate), None, PERIOD_MPS, AHEAD, True, CONFIG, rng)
    assert np.abs(found.velocity_mps - truth)[:2].max() < 0.06

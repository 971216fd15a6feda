"""The radar's own velocity and what moves: recovery on synthetic scans, ambiguity, faults."""

import numpy as np
import pytest

from pipeline.core.config import PerceiveConfig
from pipeline.perceive.ego_velocity import MOVING, STATIC, UNDECIDED, Travel, radar_motion

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


def towards(angle_deg, speed, up=0.0):
    return speed * np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg)), up])


def wrapped(rate):
    return (rate - PERIOD_MPS * np.round(rate / PERIOD_MPS)).astype(np.float32)


def motion_of(xyz, rate, rng, travel=AHEAD, *, period=PERIOD_MPS, power=None, has_elevation=True):
    """What a radar of this period makes of true rates."""
    seen = wrapped(rate) if period == PERIOD_MPS else rate
    return radar_motion(xyz, seen, power, period, travel, has_elevation, PerceiveConfig(), rng)


@pytest.mark.parametrize("speed", [0.0, 4.0, 10.394, 17.0, 31.0])
def test_the_true_velocity_is_found_among_all_multiples_of_the_period(speed):
    rng = np.random.default_rng(1)
    truth = np.array([speed, 0.02 * speed, 0.03 * speed])
    xyz, rate, _ = scan(rng, truth, movers=5)
    found = motion_of(xyz, rate, rng)
    error = found.velocity_mps - truth
    assert np.all(np.abs(error[:2]) < [0.03, 0.05])
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diag(found.velocity_cov)) + 0.02)


def test_velocity_errors_agree_with_the_reported_covariance():
    z, truth = [], np.array([9.0, 0.3, 0.2])
    for seed in range(40):
        rng = np.random.default_rng(seed)
        xyz, rate, _ = scan(rng, truth, points=200)
        found = motion_of(xyz, rate, rng)
        z.append((found.velocity_mps - truth) / np.sqrt(np.diag(found.velocity_cov)))
    assert np.all(np.std(z, axis=0) < 1.5)
    assert np.all(np.std(z, axis=0) > 0.6)


def test_moving_cars_are_told_from_the_static_world_and_become_one_cluster_each_in_every_run():
    xyz, rate, moving = scan(np.random.default_rng(3), np.array([8.0, 0.0, 0.0]), movers=5)
    found, again = (motion_of(xyz, rate, np.random.default_rng(1)) for _ in range(2))
    assert np.mean(found.motion[moving] == MOVING) > 0.95
    assert np.mean(found.motion[~moving] == STATIC) > 0.97
    labels = [set(found.cluster[6 * k : 6 * k + 6]) for k in range(5)]
    assert all(len(group) == 1 for group in labels)
    assert len(set.union(*labels)) == 5
    assert np.array_equal(found.velocity_mps, again.velocity_mps)
    assert np.array_equal(found.cluster, again.cluster)


def test_odometry_finds_the_static_world_beside_a_bus_that_fills_the_scan():
    rng = np.random.default_rng(12)
    xyz, rate, _ = scan(rng, np.array([11.0, 0.0, 0.0]), points=80)
    bus = rng.uniform([4, 3, -1], [14, 4, 1], (260, 3))
    u = bus / np.linalg.norm(bus, axis=1, keepdims=True)
    xyz = np.concatenate([xyz, bus]).astype(np.float32)
    rate = np.concatenate([rate, -23.0 * u[:, 0]]).astype(np.float32)
    found = motion_of(xyz, rate, rng, Travel(10.6, 0.0), period=40.0)
    assert found.velocity_mps[0] == pytest.approx(11.0, abs=0.1)
    assert np.mean(found.motion[:80] == STATIC) > 0.9
    assert np.mean(found.motion[80:] == MOVING) > 0.9


@pytest.mark.parametrize("points", [0, 1, 5, 400])
def test_too_few_detections_and_a_scan_without_static_world_decide_nothing(points):
    rng = np.random.default_rng(6)
    xyz, _, _ = scan(rng, np.zeros(3), points)
    noise = rng.uniform(-PERIOD_MPS / 2, PERIOD_MPS / 2, points).astype(np.float32)
    found = motion_of(xyz, noise, rng)
    assert found.velocity_mps is None
    assert found.motion.tolist() == [UNDECIDED] * points


def test_detections_that_are_not_numbers_are_undecided_and_harm_nothing():
    rng = np.random.default_rng(7)
    xyz, rate, _ = scan(rng, np.array([5.0, 0.0, 0.0]))
    xyz[::7] = np.nan
    rate[3::50] = np.inf
    found = motion_of(xyz, rate, rng, period=None, power=np.full(len(xyz), np.nan, np.float32))
    assert abs(found.velocity_mps[0] - 5.0) < 0.05
    assert np.all(found.motion[::7] == UNDECIDED)
    assert np.isfinite(found.residual_mps).all()


@pytest.mark.parametrize("period", [None, PERIOD_MPS])
@pytest.mark.parametrize(
    ("truth", "travel"),
    [
        # The bracket is 3 deg off what the prior says.
        *(
            (towards(-mounted - 3, speed, 0.02 * speed), Travel(heading_rad=-np.radians(mounted)))
            for mounted in (45.0, -45.0, 90.0, 180.0)
            for speed in (3.0, 12.0, 30.0)
        ),
        *((towards(12, speed), AHEAD) for speed in (12.0, 22.0, 33.0)),  # knocked
        *((towards(mounted, 14), Travel()) for mounted in (0.0, 45.0, -45.0, 90.0, 180.0)),  # no prior
    ],
)
def test_a_radar_that_looks_aside_or_back_or_was_knocked_finds_its_velocity(truth, travel, period):
    rng = np.random.default_rng(21)
    xyz, rate, _ = scan(rng, truth, movers=4)
    found = motion_of(xyz, rate, rng, travel, period=period)
    assert np.abs(found.velocity_mps - truth)[:2].max() < 0.06
    assert np.mean(found.motion == STATIC) > 0.9

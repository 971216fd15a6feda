"""Motion of the base out of several radars and odometry: right within its sigma, and a wrong source is named."""

import numpy as np
import pytest

from pipeline.objective.ego_motion import DopplerMotion, Odometry, backwards, ego_motion
from pipeline.rig.se3 import exp_so3, from_rotation_translation

MOMENTS = 120
NOISE_MPS = 0.05
CORNERS = {"front": (3.7, 0.0, 0.0), "left": (3.5, 0.8, 60.0), "rear": (-0.8, -0.7, -140.0)}


def motion(rng):
    """Forward speed, slip and yaw rate of a car's base."""
    t = np.arange(MOMENTS) * 0.5
    speed = 12 + 5 * np.sin(t / 7) + 2 * np.sin(t / 3)
    return np.stack([speed, rng.normal(0, 0.02, MOMENTS), 0.25 * np.sin(t / 5)], 1)


def radar(name, u, rng, off_deg=0.0, scale=1.0):
    """Own velocity of one radar whose prior is off_deg beside its true yaw."""
    x, y, yaw_deg = CORNERS[name]
    at_radar = np.stack([u[:, 0] - u[:, 2] * y, u[:, 1] + u[:, 2] * x, 0 * u[:, 0]], 1)
    R = exp_so3(np.radians([0.0, 0.0, yaw_deg]))
    seen = scale * at_radar @ R + rng.normal(0, NOISE_MPS, (MOMENTS, 3)) * [1, 1, 10]
    prior = from_rotation_translation(exp_so3(np.radians([0, 0, yaw_deg - off_deg])), np.array([x, y, 0.5]))
    covariance = np.tile(np.diag([1, 1, 100.0]) * NOISE_MPS**2, (MOMENTS, 1, 1))
    return DopplerMotion(name, seen, covariance, prior, np.radians(2.0))


def odometry(u, rng):
    return Odometry(u[:, 0] + rng.normal(0, 0.05, MOMENTS), u[:, 2] + rng.normal(0, 0.002, MOMENTS))


SILENT = Odometry(np.full(MOMENTS, np.nan), np.full(MOMENTS, np.nan))


def errors(found, u):
    return np.column_stack([found.velocity_mps, found.yaw_rate_radps]) - u


@pytest.mark.parametrize("names", [["front"], ["left", "rear"], ["front", "left", "rear"]])
@pytest.mark.parametrize("logged", [True, False])
def test_motion_is_right_within_its_sigma(names, logged):
    rng = np.random.default_rng(1)
    u = motion(rng)
    radars = [radar(n, u, rng, off_deg=1.5) for n in names]
    found = ego_motion(radars, odometry(u, rng) if logged else SILENT, heading=(0.0, 0.0))
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    spread = np.sqrt(np.mean((errors(found, u) / sigma) ** 2, axis=0))
    assert (spread < 1.6).all(), spread
    assert sigma[:, 0].max() < 0.12
    assert sigma[:, 2].max() < 0.03
    assert not found.left_out


def test_a_convoy_in_some_scans_does_not_move_the_car():
    rng = np.random.default_rng(3)
    u = motion(rng)
    front = radar("front", u, rng)
    front.velocity_mps[::7, 0] += 8.0
    found = ego_motion([front], odometry(u, rng), heading=(0.0, 0.0))
    assert np.abs(errors(found, u)[:, 0]).max() < 0.5


@pytest.mark.parametrize("wrong", ["odometry", "left"])
def test_of_three_sources_the_odd_one_is_left_out_and_named(wrong):
    rng = np.random.default_rng(4)
    u = motion(rng)
    logged = odometry(u, rng)
    if wrong == "odometry":
        logged = Odometry(logged.speed_mps * 3.6, logged.yaw_rate_radps)
    radars = [radar("front", u, rng), radar("left", u, rng, scale=-1.0 if wrong == "left" else 1.0)]
    found = ego_motion(radars, logged, heading=(0.0, 0.0))
    assert list(found.left_out) == [wrong]
    assert np.abs(errors(found, u)[:, 0]).max() < 0.4


def test_the_direction_of_all_rests_on_the_mountings():
    rng = np.random.default_rng(5)
    u = motion(rng)
    radars = [radar("front", u, rng, off_deg=3.0), radar("rear", u, rng, off_deg=-1.0)]
    found = ego_motion(radars, odometry(u, rng))
    heading = np.median(np.arctan2(found.velocity_mps[:, 1], found.velocity_mps[:, 0]))
    # Both priors' mean error, their own way.
    assert heading == pytest.approx(np.radians(-1.0), abs=np.radians(0.2))


def test_who_drives_backwards_is_named_where_somebody_drives_ahead():
    ahead = np.full(20, 9.0)
    reverse = np.where(np.arange(20) < 4, -2.0, 9.0)  # out of a parking space
    assert backwards({"front": -ahead, "odometry": reverse}) == ["front"]
    assert backwards({"front": -ahead, "rear": -ahead, "odometry": ahead}) == ["front", "rear"]
    assert backwards({"front": ahead, "odometry": -ahead}) == ["odometry"]
    assert backwards({"front": -ahead, "odometry": -ahead}) == []  # the base's axes, or a car that does
    assert backwards({"front": -ahead, "odometry": np.full(20, np.nan)}) == []
    assert backwards({"front": -ahead[:5], "odometry": ahead}) == []  # too few moments

"""What may be claimed at the targets, and the held-out update: laws, coverage, contradiction."""

import numpy as np
import pytest
from scipy.stats import norm

from pipeline.calibrate.verify.held_out import held_out_update
from pipeline.calibrate.verify.target_accuracy import Claim, claims_of, target_jacobian
from pipeline.rig.se3 import exp_se3, exp_so3, from_rotation_translation
from pipeline.rig.targets import errors_at_targets

AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # camera from lidar
T_CAMERA = from_rotation_translation(AXES, np.array([0.1, -0.3, -0.5]))
T_RADAR = from_rotation_translation(exp_so3(np.array([0.0, 0.02, 0.1])), np.array([2.0, 0.2, -1.0]))
POSES = {"camera_lidar": T_CAMERA, "camera_radar": T_CAMERA @ T_RADAR, "lidar_radar": T_RADAR}
SIGMA = np.array([*np.radians([0.05] * 3), 0.02, 0.02, 0.02])


@pytest.mark.parametrize("pair", POSES)
def test_the_jacobian_predicts_the_errors_at_the_targets(pair):
    rng = np.random.default_rng(0)
    J = target_jacobian(pair, POSES[pair])
    for _ in range(5):
        xi = rng.normal(size=6) * 1e-3
        found = errors_at_targets(pair, exp_se3(xi) @ POSES[pair], POSES[pair])
        np.testing.assert_allclose(np.abs(J @ xi).mean(axis=1), found[:2], atol=2e-5)


def test_the_bound_is_the_quantile_of_the_absolute_error():
    for shift, sigma, confidence in (
        (0.0, 0.1, 0.995),
        (0.05, 0.1, 0.995),
        (1.0, 0.1, 0.995),
        (0.02, 0.1, 0.9),
    ):
        bound = Claim(sigma, shift, 1e-3, 9.0, 0.2, confidence).bound_rad
        inside = norm.cdf(bound, shift, sigma) - norm.cdf(-bound, shift, sigma)
        assert inside == pytest.approx(confidence, abs=1e-9)


def test_the_own_sigma_decides_until_held_out_frames_contradict_it():
    agreed = Claim(0.05, 0.1, 0.05, 0.045, 0.2, 0.995)
    assert agreed.bound_rad == pytest.approx(0.05 * norm.ppf(0.9975))
    contradicted = Claim(0.05, 0.1, 0.03, 0.045, 0.2, 0.995)
    assert contradicted.is_contradicted
    assert contradicted.bound_rad > 0.2 > agreed.bound_rad


def quadratic_frames(truth, blocks, rng, scatter=1.0, information=400.0):
    """Log likelihoods of frames with a common optimum near `truth` (steps of 6, dt, nuisance), by block."""
    F = len(blocks)
    scale = np.array([*np.radians([0.3] * 3), 0.1, 0.1, 0.1, 0.01, 0.003])
    H = np.broadcast_to(np.diag(information / scale**2) / F, (F, 8, 8))
    shared = rng.normal(size=(blocks.max() + 1, 8)) * scatter * np.sqrt(information / (blocks.max() + 1))
    noise = shared[blocks] / np.bincount(blocks)[blocks][:, None] / scale

    def derivatives(step, width):
        del width
        return noise - np.einsum("fij,j->fi", H, step - truth), H

    return derivatives


COVARIANCE = np.diag([*SIGMA**2, 0.005**2, 0.003**2])
BIAS = np.zeros(8)


def updates(count, scatter=1.0, off=0.0, blocks=12):
    """Held-out updates of results whose errors are as their covariance says, and then `off` [rad] more in yaw."""
    rng = np.random.default_rng(3)
    block = np.repeat(np.arange(blocks), 3)
    for _ in range(count):
        error = rng.normal(size=8) * np.sqrt(np.diag(COVARIANCE)) + off * np.eye(8)[2]
        found = held_out_update(quadratic_frames(-error, block, rng, scatter), COVARIANCE, BIAS, block)
        yield error, found


@pytest.mark.parametrize("scatter", [1.0, 4.0])
def test_a_held_out_update_is_right_about_its_own_sigma_however_much_scenes_scatter(scatter):
    remaining, shifts = [], []
    for error, found in updates(150, scatter):
        remaining.append((error[:6] + found.shift)[2] / np.sqrt(found.covariance[2, 2]))
        shifts.append(found.shift[2] / np.sqrt(found.shift_covariance[2, 2]))
    assert 0.75 < np.std(remaining) < 1.15
    assert 0.75 < np.std(shifts) < 1.2
    assert np.mean(np.abs(shifts) > 3) < 0.03


def test_a_result_that_is_off_by_many_sigmas_is_contradicted():
    contradicted = []
    for _, found in updates(40, off=np.radians(0.5)):
        claim = claims_of("lidar_radar", np.eye(4), COVARIANCE[:6, :6], found, np.radians(0.4), 0.995)
        contradicted.append(claim["azimuth"].is_contradicted)
    assert np.mean(contradicted) > 0.95


def test_frames_that_say_nothing_change_nothing_and_two_scenes_are_too_few():
    rng = np.random.default_rng(0)
    block = np.repeat(np.arange(6), 2)
    found = held_out_update(
        quadratic_frames(np.zeros(8), block, rng, information=1e-6), COVARIANCE, BIAS, block
    )
    np.testing.assert_allclose(found.covariance, COVARIANCE[:6, :6], rtol=1e-3)
    assert np.all(np.abs(found.shift) < 1e-3 * SIGMA)
    two = np.repeat([0, 1], 6)
    assert held_out_update(quadratic_frames(np.zeros(8), two, rng), COVARIANCE, BIAS, two) is None


def test_held_out_frames_make_nothing_surer_than_their_own_bias():
    rng = np.random.default_rng(1)
    block = np.repeat(np.arange(12), 3)
    bias = np.array([0, 0, np.radians(0.2), 0, 0, 0, 0, 0])
    wide = COVARIANCE * 100
    found = held_out_update(quadratic_frames(np.zeros(8), block, rng, information=1e6), wide, bias, block)
    claim = claims_of("lidar_radar", np.eye(4), wide[:6, :6], found, np.radians(0.4), 0.995)["azimuth"]
    assert np.degrees(claim.remaining_sigma_rad) == pytest.approx(0.2, abs=0.02)
    sharp = COVARIANCE / 100
    found = held_out_update(quadratic_frames(np.zeros(8), block, rng), sharp, bias, block)
    claim = claims_of("lidar_radar", np.eye(4), sharp[:6, :6], found, np.radians(0.4), 0.995)["azimuth"]
    assert claim.remaining_sigma_rad == claim.sigma_rad  # and nothing less sure than it was

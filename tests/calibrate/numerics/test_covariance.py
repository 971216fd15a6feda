"""Covariances: what blocks, the prior and the information each contribute; coverage of a simulated estimator."""

import numpy as np
import pytest

from pipeline.calibrate.numerics.covariance import (
    bootstrap_covariance,
    covariance_with_fixed,
    posterior,
    response,
    widening,
)
from pipeline.calibrate.numerics.frame_blocks import bootstrap_blocks


def linear_day(rng, frames=200, shared=0.0, sigma=1.0):
    """A line fit: information and score per frame at the estimate; a drive shares the part `shared` of its variance."""
    x = rng.normal(size=frames)
    A = np.stack([np.ones(frames), x], -1)
    drive = np.arange(frames) // 10
    noise = sigma * (
        np.sqrt(1 - shared) * rng.normal(size=frames) + np.sqrt(shared) * rng.normal(size=20)[drive]
    )
    estimate = np.linalg.lstsq(A, noise, rcond=None)[0]
    H = A[:, :, None] * A[:, None, :]
    return estimate, H, A * (A @ estimate - noise)[:, None], drive


def test_errors_shared_by_a_drive_widen_the_covariance_and_cover_the_truth():
    z, naive = [], []
    for seed in range(120):
        rng = np.random.default_rng(seed)
        estimate, H, g, drive = linear_day(rng, shared=0.5)
        covariance = bootstrap_covariance(
            H, g, np.zeros((2, 2)), bootstrap_blocks(drive, np.arange(len(drive))), rng
        )
        z.append(estimate[0] / np.sqrt(covariance[0, 0]))
        naive.append(estimate[0] / np.sqrt(np.linalg.inv(H.sum(0))[0, 0]))
    assert np.std(naive) > 1.7
    assert 0.75 < np.std(z) < 1.4


def test_a_single_block_has_no_spread_and_is_as_unsure_as_two():
    rng = np.random.default_rng(0)
    _, H, g, _ = linear_day(rng)
    found = bootstrap_covariance(H, g, np.eye(2), np.zeros(200, np.int64), rng)
    assert np.allclose(found, widening(2.0) ** 2 * np.linalg.inv(H.sum(0) + np.eye(2)))


@pytest.mark.parametrize("blocks", [3, 5, 9, 20])
def test_the_covariance_covers_the_truth_with_few_blocks_too(blocks):
    """Blocks whose frames err alike: within two sigmas as often as two sigmas say, however few they are."""
    z = []
    for seed in range(400):
        rng = np.random.default_rng([seed, blocks])
        block = np.repeat(np.arange(blocks), 10)
        noise = rng.normal(size=blocks)[block] + 0.1 * rng.normal(size=len(block))
        g = (noise.mean() - noise)[:, None]
        H = np.full((len(block), 1, 1), 1.0)
        covariance = bootstrap_covariance(H, g, np.zeros((1, 1)), block, rng)
        z.append(noise.mean() / np.sqrt(covariance[0, 0]))
    assert 0.9 < np.mean(np.abs(z) < 1.96) < 0.985


def test_a_block_that_outweighs_the_day_is_not_taken_for_sure():
    """Sixty frames of one view and forty of others: the estimate follows the one, whose residual is small for that."""
    z = []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        block = np.r_[np.zeros(60, int), 1 + np.arange(40) // 2]
        noise = rng.normal(size=21)[block]
        g = (noise.mean() - noise)[:, None]
        covariance = bootstrap_covariance(np.ones((100, 1, 1)), g, np.zeros((1, 1)), block, rng)
        z.append(noise.mean() / np.sqrt(covariance[0, 0]))
    assert np.mean(np.abs(z) < 1.96) > 0.93


@pytest.mark.parametrize(
    "drive", [np.zeros(100, int), np.arange(100), np.repeat(np.arange(5), [3, 50, 7, 20, 20])]
)
def test_blocks_are_runs_of_frames_of_similar_size(drive):
    block = bootstrap_blocks(drive, np.arange(len(drive)))
    assert np.all(np.diff(block) >= 0)
    assert np.all(np.diff(block) <= 1)
    assert 8 <= block.max() + 1 <= 30
    assert np.bincount(block).max() <= 9


def test_an_unobservable_dof_keeps_the_prior_sigma_and_says_so():
    prior = np.diag([1e-3] * 3 + [2.5e-3] * 3)
    covariance = 0.1 * prior
    covariance[0, 0] = 0.9 * prior[0, 0]
    covariance[0, 2] = covariance[2, 0] = 0.5 * np.sqrt(covariance[0, 0] * covariance[2, 2])
    after = posterior(covariance, prior, np.zeros(6))
    assert after.observable.tolist() == [False, True, True, True, True, True]
    assert after.covariance[0, 0] == pytest.approx(prior[0, 0])
    assert after.covariance[2, 2] == pytest.approx(covariance[2, 2])
    assert np.linalg.eigvalsh(after.covariance).min() > 0
    assert after.observability[0] == pytest.approx(0.1)


def test_parameters_that_follow_a_held_one_inherit_its_uncertainty_and_cover_the_truth():
    held, prior_variance = np.array([False, True]), np.array([100.0, 0.04])
    z, deaf = [], []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        truth = np.array([0.0, 0.2 * rng.normal()])  # the prior of the second is 0 +- 0.2
        x = rng.normal(size=200)
        A = np.stack([np.ones(200) + 0.5 * x, np.ones(200)], -1)
        y = A @ truth + rng.normal(size=200)
        estimate = np.array([A[:, 0] @ y / (A[:, 0] @ A[:, 0]), 0.0])
        H, g = A[:, :, None] * A[:, None, :], A * (A @ estimate - y)[:, None]
        curvature = H.sum(0) + np.diag(1 / prior_variance)
        covariance = covariance_with_fixed(H, g, prior_variance, curvature, held, np.arange(200) // 5, rng)
        assert covariance[1, 1] == pytest.approx(prior_variance[1])
        assert covariance[0, 1] < 0
        z.append((estimate[0] - truth[0]) / np.sqrt(covariance[0, 0]))
        deaf.append((estimate[0] - truth[0]) * np.sqrt(curvature[0, 0]))
    assert np.std(deaf) > 2.0
    assert 0.85 < np.std(z) < 1.15


def test_the_optimum_follows_along_the_valley_and_leaves_alone_what_is_held():
    curvature = np.array([[4.0, 2.0, 0.0], [2.0, 5.0, 1.0], [0.0, 1.0, 3.0]])
    given, held = np.array([False, True, False]), np.array([False, False, True])
    np.testing.assert_allclose(response(curvature, given, held), [[-0.5], [1.0], [0.0]])
    np.testing.assert_allclose(response(curvature, given, np.zeros(3, bool)), [[-0.5], [1.0], [-1 / 3]])


def test_no_direction_is_surer_than_the_information():
    rng = np.random.default_rng(0)
    _, H, g, drive = linear_day(rng)
    found = bootstrap_covariance(H, 1e-6 * g, np.eye(2), drive, rng)
    least = np.linalg.inv(H.sum(0) + np.eye(2))
    assert np.linalg.eigvalsh(found - least).min() > -1e-12


def test_the_bias_floor_is_never_undercut():
    floor = np.array([1, 2, 3, 4, 5, 6]) * 1e-3
    after = posterior(np.eye(6) * 1e-12, np.eye(6), floor)
    assert np.all(np.sqrt(np.diag(after.covariance)) >= floor)

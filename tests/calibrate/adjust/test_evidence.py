"""Evidence of an edge from a pair's estimate: the prior is taken out, and put back once it is the estimate again."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.adjust.equations import evidence_of
from pipeline.calibrate.adjust.rig import adjust
from pipeline.rig.estimates import EDGE, Check, PairEstimate, Prior
from pipeline.rig.graph import EDGE_OF_PAIR, RigGraph
from pipeline.rig.prior import Extrinsics
from pipeline.rig.se3 import (
    change_between,
    change_covariance,
    change_jacobian,
    changed,
    exp_so3,
    from_rotation_translation,
)

CLOCK_S = 0.02
AHEAD = from_rotation_translation(
    np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.1, -0.3, -0.8])
)
PRIOR = Prior(
    AHEAD, from_rotation_translation(exp_so3(np.array([0, 0, 0.4])), np.array([2.0, 0.3, -1.0])), 0.035, 0.05
)


def estimate_of(pair, noise, offset, bias=None, in_weights=None, fixed=()):
    """What a solver makes of data (covariance `noise`, optimum `offset` from the prior) and the prior.

    `bias` is added to the covariance; `in_weights` is part of `noise`; of `fixed` unknowns the data are not asked.
    """
    free = np.array([k not in fixed for k in range(6)])
    P = PRIOR.covariance(pair)
    W = np.zeros((6, 6))
    W[np.ix_(free, free)] = np.linalg.inv(noise[np.ix_(free, free)])
    C = np.linalg.inv(W + np.linalg.inv(P))
    x = C @ W @ offset
    T = changed(PRIOR.of(pair), x)
    to_left = np.linalg.inv(change_jacobian(T))
    bias = (
        {}
        if bias is None
        else {o: to_left @ np.diag(np.where(free, B, 0.0)) @ to_left.T for o, B in bias.items()}
    )
    covariance = to_left @ C @ to_left.T + sum(bias.values(), np.zeros((6, 6)))
    if in_weights is not None:
        K = C @ W
        in_weights = to_left @ K @ np.diag(in_weights) @ K.T @ to_left.T
    return PairEstimate(
        pair, T, covariance, np.ones(6), free, 40, time_offset_s=0.013, time_offset_sigma_s=0.004,
        bias=bias, bias_in_weights=in_weights, time_offset_prior_s=0.01,
    )  # fmt: skip


def noise_of(rng, scale=1.0):
    sigma = scale * np.array([*np.radians([0.05, 0.05, 0.08]), 0.01, 0.02, 0.02])
    root = np.diag(sigma) @ (np.eye(6) + 0.3 * rng.normal(size=(6, 6)))
    return root @ root.T


def alone(estimate, prior=PRIOR):
    edge = EDGE_OF_PAIR[estimate.pair]
    evidence = replace(evidence_of(estimate, edge, prior, CLOCK_S), checks=())
    T, parent, child = prior.of(edge.kind), edge.parent.name, edge.child.name
    to_left = np.linalg.inv(change_jacobian(T))
    covariance = to_left @ prior.covariance(edge.kind) @ to_left.T
    dt_s = {parent: 0.0, child: estimate.time_offset_prior_s}
    poses = Extrinsics(edge.parent, {parent: np.eye(4), child: T}, (child,), covariance, covariance, dt_s)
    return adjust(RigGraph(edge.sensors, (edge,), edge.parent), poses, [evidence], CLOCK_S)


@pytest.mark.parametrize("pair", ["camera_lidar", "lidar_radar"])
def test_evidence_and_prior_solved_alone_are_the_pairs_estimate(pair):
    rng = np.random.default_rng(0)
    for _ in range(5):
        offset = rng.normal(size=6) * [0.01] * 6
        estimate = estimate_of(pair, noise_of(rng), offset)
        found, (parent, child) = alone(estimate), pair.split("_")
        C = found.poses.covariance_between(parent, child)
        apart = change_between(estimate.T, found.poses.between(parent, child))
        # Of the second order of a turn of .6 deg: a hundredth of a sigma.
        assert np.all(
            np.abs(apart) < 0.01 * np.sqrt(np.diag(change_covariance(estimate.T, estimate.covariance)))
        )
        np.testing.assert_allclose(C, estimate.covariance, rtol=0.01, atol=0.01 * np.abs(C).max())
        assert found.sensors[child].dt_sigma_s == pytest.approx(0.004, rel=1e-6)
        assert found.poses.dt_s[child] == pytest.approx(0.013, abs=1e-9)


def test_data_alone_are_found_again_though_the_prior_had_most_of_the_say():
    rng = np.random.default_rng(1)
    noise, offset = noise_of(rng, 15.0), rng.normal(size=6) * 0.02
    estimate = estimate_of("lidar_radar", noise, offset)
    evidence = evidence_of(estimate, EDGE_OF_PAIR["lidar_radar"], PRIOR, CLOCK_S)
    to_left = np.linalg.inv(change_jacobian(estimate.T))
    data = np.linalg.inv(evidence.information[:6, :6])
    np.testing.assert_allclose(data, to_left @ noise @ to_left.T, rtol=1e-6, atol=1e-9)
    optimum = changed(PRIOR.T_lidar_radar, offset)
    beyond = np.linalg.solve(to_left, data @ evidence.gradient[:6])
    np.testing.assert_allclose(beyond, change_between(estimate.T, optimum), atol=2e-3)


def test_what_the_day_did_not_move_has_no_information():
    estimate = estimate_of("camera_lidar", noise_of(np.random.default_rng(2)), np.zeros(6), fixed=(3, 5))
    evidence = evidence_of(estimate, EDGE_OF_PAIR["camera_lidar"], PRIOR, CLOCK_S)
    assert np.linalg.matrix_rank(evidence.information[:6, :6], tol=1e-6) == 4
    covariance = alone(estimate).poses.covariance_between("camera", "lidar")
    sigma = np.sqrt(np.diag(estimate.covariance))
    np.testing.assert_allclose(
        covariance / np.outer(sigma, sigma), estimate.covariance / np.outer(sigma, sigma), atol=0.01
    )


def test_biases_are_handed_over_by_owner_and_are_not_in_the_information():
    rng = np.random.default_rng(3)
    noise, turn = noise_of(rng), np.radians(0.2) ** 2
    bias = {"radar": np.array([turn, turn, turn, 0, 0, 0]), EDGE: np.array([0, 0, 0, 1e-4, 1e-4, 1e-4])}
    plain = estimate_of("lidar_radar", noise, np.zeros(6))
    estimate = estimate_of("lidar_radar", noise, np.zeros(6), bias)
    evidence = evidence_of(estimate, EDGE_OF_PAIR["lidar_radar"], PRIOR, CLOCK_S)
    assert set(evidence.bias) == {"radar", EDGE}
    np.testing.assert_allclose(evidence.bias["radar"][:3, :3], turn * np.eye(3), atol=1e-12)  # in any axes
    data = evidence_of(plain, EDGE_OF_PAIR["lidar_radar"], PRIOR, CLOCK_S).information
    np.testing.assert_allclose(evidence.information, data, rtol=1e-6, atol=1e-3)
    found = alone(estimate).poses
    sigma = np.sqrt(np.diag(change_covariance(estimate.T, found.covariance_between("lidar", "radar"))))
    today = np.sqrt(np.diag(change_covariance(estimate.T, estimate.covariance)))
    np.testing.assert_allclose(sigma, today, rtol=0.05)


def test_a_bias_that_the_weights_have_in_them_is_stated_in_full():
    rng, sigma2 = np.random.default_rng(4), np.array([np.radians(0.3) ** 2, 0, 0, 0, 0, 0])
    noise = noise_of(rng) + np.diag(sigma2)
    estimate = estimate_of("lidar_radar", noise, np.zeros(6), in_weights=sigma2)
    evidence = evidence_of(estimate, EDGE_OF_PAIR["lidar_radar"], PRIOR, CLOCK_S)
    to_left = np.linalg.inv(change_jacobian(estimate.T))
    np.testing.assert_allclose(
        evidence.bias[EDGE], to_left @ np.diag(sigma2) @ to_left.T, rtol=1e-3, atol=1e-8
    )
    total = np.linalg.inv(evidence.information[:6, :6]) + evidence.bias[EDGE]
    np.testing.assert_allclose(total, to_left @ noise @ to_left.T, rtol=1e-3, atol=1e-8)


def test_failed_checks_travel_and_a_pair_that_shows_nothing_has_no_information():
    estimate = replace(PairEstimate.at_prior("camera_lidar", PRIOR), disproved="lost")
    evidence = evidence_of(estimate, EDGE_OF_PAIR["camera_lidar"], PRIOR, CLOCK_S, [Check("held out")])
    assert [c.sentence for c in evidence.checks] == ["held out", "lost"]
    assert not evidence.information.any()
    assert not evidence.gradient.any()

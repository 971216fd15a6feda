"""Differential evolution and Nelder-Mead, alone and with the loop; the paper's signs of misalignment."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.methods import METHODS, method_named
from pipeline.calibrate.numerics.covariance import sandwich_covariance
from pipeline.calibrate.paper_methods import (
    joint_costs,
    minimise,
    pair_problem,
    solve_joint_optimisation,
    solve_pairwise,
)
from pipeline.calibrate.select.triggers import exceeded, trigger_metrics
from pipeline.core.config import SolveConfig, TriggerConfig
from pipeline.core.errors import ConfigError
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import changed, log_se3, perturb_exactly, rotation_angle_rad
from pipeline.rig.targets import errors_at_targets
from schemas.calibrations import METHODS as METHOD_NAMES
from schemas.calibrations import PAIRS
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day, turned

CONFIG = SolveConfig(
    search_rotation_deg=4.0, search_translation_m=0.2, paper_population=40, paper_generations=30
)
TRUTH = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2), 0.05)


@pytest.fixture(scope="module")
def frames():
    day = make_day(24)
    return dict.fromkeys(PAIRS, day)


@pytest.fixture(scope="module")
def prior():
    rng = np.random.default_rng(3)
    return Prior(
        perturb_exactly(T_CAMERA_LIDAR, np.radians(2), 0.1, rng),
        perturb_exactly(T_LIDAR_RADAR, np.radians(2), 0.1, rng), np.radians(2), 0.1,
    )  # fmt: skip


@pytest.fixture(scope="module")
def pairwise(frames, prior):
    return solve_pairwise(frames, prior, CONFIG, seed=1)


@pytest.fixture(scope="module")
def joint(frames, prior):
    return solve_joint_optimisation(frames, prior, CONFIG, seed=1)


def searched(population, generations):
    """A search of 0.07 rad and 0.2 m to each side."""
    return SolveConfig(
        search_rotation_deg=np.degrees(0.07), search_translation_m=0.2, paper_population=population,
        paper_generations=generations,
    )  # fmt: skip


def test_minimise_finds_the_lowest_of_several_basins():
    target = np.array([0.03, -0.02, 0.01, 0.05, -0.1, 0.0])

    def bumpy(x):
        d = (x - target) / np.array([0.02] * 3 + [0.1] * 3)
        return (d**2).sum(axis=1) + 2 * (1 - np.cos(5 * d)).sum(axis=1)

    found = minimise(bumpy, searched(60, 120), np.zeros(6), np.random.default_rng(0))
    np.testing.assert_allclose(found.x, target, atol=1e-3)
    assert not found.at_border
    assert found.evaluations > 60 * 30


@pytest.mark.parametrize("pair", PAIRS)
def test_pairwise_and_joint_lower_the_loss_and_recover_the_truth_at_the_targets(pairwise, joint, prior, pair):
    estimate = pairwise.pairs[pair]
    assert estimate.diagnostics["loss_result"] < estimate.diagnostics["loss_prior"]
    before, *after = (
        errors_at_targets(pair, T, TRUTH.of(pair))[:2]
        for T in (prior.of(pair), estimate.T, joint.pairs[pair].T)
    )
    assert np.degrees(after).max() < 0.6
    assert after[0].sum() < before.sum()


def test_joint_closes_the_loop_that_pairwise_leaves_open(pairwise, joint):
    assert pairwise.loop_rotation_rad > np.radians(0.05)
    assert joint.loop_rotation_rad < np.radians(0.01)
    assert joint.loop_translation_m < 1e-3


def test_pairs_that_did_not_trigger_keep_the_prior(frames, prior):
    for solve in (solve_pairwise, solve_joint_optimisation):
        solution = solve(frames, prior, CONFIG, seed=0, triggered=["camera_radar"])
        for pair in ("camera_lidar", "lidar_radar"):
            assert np.array_equal(solution.pairs[pair].T, prior.of(pair))
            assert not solution.pairs[pair].observable.any()
            assert "not triggered" in solution.pairs[pair].notes[0]
        assert rotation_angle_rad(solution.pairs["camera_radar"].T @ np.linalg.inv(prior.T_camera_radar)) > 0


def test_joint_objective_is_one_plus_losses_times_one_plus_loop(frames, prior):
    problems = {pair: pair_problem(pair, frames[pair], prior, CONFIG) for pair in PAIRS}
    scales = {"camera_lidar": 0.5, "lidar_radar": 2.0}
    x = np.zeros((2, 12))
    x[1, 0] = 0.01
    cost = joint_costs(problems, prior, scales, x)
    losses = {p: problems[p].loss(np.stack([prior.of(p)]))[0] for p in scales}
    assert cost[0] == pytest.approx(
        1 + losses["camera_lidar"] / 0.5 + losses["lidar_radar"] / 2.0
    )  # the prior's loop is closed
    moved = problems["camera_lidar"].loss(changed(prior.T_camera_lidar, x[1:, :6]))[0]
    T_loop = changed(prior.T_camera_lidar, x[1:, :6])[0] @ np.linalg.inv(prior.T_camera_lidar)
    loop = 0.01 + np.abs(T_loop[:3, 3]).sum()
    assert cost[1] == pytest.approx((1 + moved / 0.5 + losses["lidar_radar"] / 2.0) * (1 + loop), rel=1e-9)


def test_sandwich_covariance_is_that_of_the_mean_for_independent_quadratic_losses():
    rng = np.random.default_rng(0)
    sigma = np.array([0.004] * 3 + [0.05] * 3)
    centres = rng.normal(size=(4000, 6)) * sigma

    def frame_losses(T):
        return (((log_se3(T)[:, None] - centres[None]) / sigma) ** 2).sum(axis=2)

    wide = np.eye(6) * 100.0
    covariance, observability = sandwich_covariance(
        frame_losses, np.eye(4), np.arange(4000), wide, (0.0, 0.0)
    )
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sigma / np.sqrt(4000), rtol=0.05)
    assert np.all(observability > 0.999)


def test_sandwich_keeps_the_prior_along_what_the_losses_do_not_see():
    def blind(T):
        return np.outer(T[:, 0, 3] ** 2, np.ones(20))  # sees tx only

    prior_covariance = np.diag([1e-3] * 3 + [0.01] * 3)
    covariance, observability = sandwich_covariance(
        blind, np.eye(4), np.arange(20), prior_covariance, (0.0, 0.0)
    )
    np.testing.assert_allclose(covariance[1, 1], 1e-3, rtol=0.05)
    assert observability[3] > 0.9
    assert observability[[0, 1, 2, 4, 5]].max() < 0.1


def test_every_method_of_the_table_resolves_and_others_are_a_usage_error():
    for method in METHODS:
        if not method.needs_images:
            assert callable(method.solver())
    assert [m.name for m in METHODS] == list(METHOD_NAMES)  # what the records' column is promised to hold
    with pytest.raises(ConfigError, match="does not exist") as caught:
        method_named("magic")
    assert caught.value.exit_code == 2


def test_uncertainty_is_said_to_be_ours_and_is_no_smaller_than_the_bias_floor(pairwise):
    estimate = pairwise.pairs["camera_lidar"]
    assert "the paper gives no uncertainty" in estimate.notes[0]
    assert np.all(np.sqrt(np.diag(estimate.covariance)[:3]) >= np.radians(0.33))


@pytest.fixture(scope="module")
def aged():
    return [with_ages(o, 3) for o in make_day(10)]


def with_ages(observation, age):
    n = len(observation.radar_track_xyz_m)
    return replace(observation, radar_track_age=np.full(n, age, np.int32))


def transforms(camera_lidar=T_CAMERA_LIDAR, lidar_radar=T_LIDAR_RADAR):
    given = {"camera_lidar": camera_lidar, "lidar_radar": lidar_radar}
    return given | {"camera_radar": camera_lidar @ lidar_radar}


def test_nothing_fires_at_the_truth(aged):
    metrics = trigger_metrics(aged, transforms())
    config = TriggerConfig(
        lidar_outside_fraction=0.03, drivable_outside_fraction=0.25
    )  # half-size labels, ragged cells
    assert {pair: exceeded(m, config) for pair, m in metrics.items()} == {p: [] for p in metrics}


def test_a_turned_camera_fires_both_of_its_pairs_and_not_lidar_radar(aged):
    metrics = trigger_metrics(aged, transforms(camera_lidar=turned(T_CAMERA_LIDAR, 1, 5)))
    assert exceeded(metrics["camera_lidar"], TriggerConfig()) == ["lidar_outside_fraction"]
    assert exceeded(metrics["camera_radar"], TriggerConfig()) == ["radar_outside_image"]
    assert metrics["lidar_radar"] == trigger_metrics(aged, transforms())["lidar_radar"]


def test_a_turned_radar_fires_lidar_radar_by_both_metrics(aged):
    metrics = trigger_metrics(aged, transforms(lidar_radar=turned(T_LIDAR_RADAR, 2, 8)))["lidar_radar"]
    assert exceeded(metrics, TriggerConfig()) == ["radar_outside_lidar", "drivable_outside_fraction"]
    assert metrics["radar_outside_lidar"] > 3


def test_a_metric_that_no_frame_can_show_is_left_out(aged):
    empty = [with_ages(replace(o, radar_track_xyz_m=np.zeros((0, 3), np.float32)), 3) for o in aged]
    for quiet in (empty, [with_ages(o, 1) for o in aged]):  # clusters of one scan are not tracked yet
        metrics = trigger_metrics(quiet, transforms())
        assert metrics["camera_radar"] == {}
        assert list(metrics["lidar_radar"]) == ["drivable_outside_fraction"]
        assert exceeded(metrics["camera_radar"], TriggerConfig()) == []

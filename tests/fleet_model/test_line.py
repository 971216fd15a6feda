"""What a line shares, recovered from lines with a known truth, and what it does to its vehicles' answers."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from pipeline.fleet_model.answers import DIFFERS_SIGMAS, largest_change_without_one, with_line
from pipeline.fleet_model.apart import shared_axes, shared_errors, told_apart, widened
from pipeline.fleet_model.contradictions import contradiction_of, motion_of
from pipeline.fleet_model.evidence import shifts_in_sigmas
from pipeline.fleet_model.line import LinePrior, learn_line
from pipeline.geometry.changes import changed
from pipeline.geometry.se3 import exp_se3, transform_points
from tests.makers.lines import COMMON, DEG, DRAWING, NOISE, Line, make_line

LABELS = np.array([0.0, 0.04 * DEG, 0.0, 0.0, 0.0, 0.0])
# As records say it, whatever the bias of a line really is.
PRIOR = LinePrior(np.diag(DRAWING**2), np.diag(COMMON**2))
SAID = np.broadcast_to(PRIOR.bias, (100, 6, 6)).copy()


def answers(line: Line):
    model = learn_line(line.evidence, line.prior)
    return model, with_line(model, line.evidence, line.common)


def sigmas(found) -> np.ndarray:
    return np.sqrt(np.einsum("nmm->nm", found.covariance))


@pytest.mark.parametrize("scatter", [0.0, 0.5, 1.0, 4.0])
def test_scatter_of_mounts_is_found_within_its_sigma(scatter):
    z = []
    for seed in range(12):
        model = learn_line((line := make_line(100, scatter, seed)).evidence, line.prior)
        z.append((model.variance - (scatter * NOISE) ** 2) / model.variance_sigma)
    assert np.abs(np.mean(z)) < 0.5
    assert np.sqrt(np.mean(np.square(z))) < 1.4


@pytest.mark.parametrize("scatter", [0.0, 0.5, 1.0, 4.0])
def test_answers_with_the_line_hold_their_sigmas(scatter):
    z = []
    for seed in range(12):
        bias = COMMON * np.random.default_rng([seed, 9]).normal(size=6)
        line = make_line(100, scatter, seed, bias=bias)
        found = with_line(learn_line(line.evidence, PRIOR), line.evidence, SAID)
        z.append((found.change - line.mounts) / sigmas(found))
    assert np.mean(np.abs(z) < 3) > 0.99
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.1


def test_equal_mounts_make_answers_surer_and_better_and_scattered_mounts_do_not():
    def gain(scatter):
        line = make_line(100, scatter, 3)
        _, found = answers(line)
        error = np.sqrt(np.mean(((found.change - line.mounts) / NOISE) ** 2))
        own = np.sqrt(np.einsum("nmm->nm", found.covariance) - COMMON**2)
        return error, float(np.mean(own / NOISE))

    error, sigma = gain(0.0)
    assert error < 0.5
    assert sigma < 0.55
    error, sigma = gain(10.0)
    assert error == pytest.approx(1.0, abs=0.12)
    assert sigma == pytest.approx(1.0, abs=0.05)


def test_what_no_data_tell_apart_keeps_the_sigma_that_records_state():
    bias = np.array([0, 0.8 * DEG, 0, 0.04, 0, 0])
    line = make_line(200, 0.5, 1, bias=bias)
    model, found = answers(line)
    errors = shared_errors(model, shared_axes("lidar_radar", np.eye(3)))
    assert not any(e.told for e in errors)
    elevation = errors[0]
    assert elevation.total == pytest.approx(0.8 * DEG, abs=3 * elevation.total_sigma)
    assert elevation.total_sigma < 0.02 * DEG
    assert (sigmas(found) > 0.99 * np.sqrt(np.diag(line.prior.bias))).all()
    np.testing.assert_allclose(told_apart(model)[0][6:], 0.0, atol=1e-12)


@pytest.mark.parametrize("kind", ["lidar_radar", "camera_radar", "radar_base", "camera_lidar"])
def test_a_shared_error_looks_like_the_change_that_brings_its_points_back(kind):
    rng = np.random.default_rng(2)
    e, parent = 1e-4, kind.split("_")[0]
    T = exp_se3(np.r_[0.3 * rng.normal(size=3), rng.normal(size=3)])
    for name, h in shared_axes(kind, T[:3, :3]).items():
        ahead = rng.normal(size=(50, 3)) + ([0, 0, 30] if name.startswith("camera") else [30, 0, 0])
        if name.startswith("camera"):
            step = [0, e, 0] if "vertical" in name else [e, 0, 0]
            seen = ahead + ahead[:, 2:] * step
        else:
            left, up = (e, 0) if "azimuth" in name else (0, e if "elevation" in name else 0)
            seen = ahead + ahead[:, :1] * [0, left, up]
            if "range" in name:
                seen = ahead * (1 + e / np.linalg.norm(ahead, axis=1, keepdims=True))
        other = transform_points(np.linalg.inv(T) if name.startswith(parent) else T, ahead)
        found = changed(T, e * h)
        # The changed transform brings what is seen to where the other sensor sees it.
        brought = (
            transform_points(found, other) - seen
            if name.startswith(parent)
            else transform_points(found, seen) - other
        )
        before = (
            transform_points(T, other) - seen
            if name.startswith(parent)
            else transform_points(T, seen) - other
        )
        assert np.abs(brought).max() < 0.2 * np.abs(before).max()


def test_a_witness_of_the_mount_tells_a_shared_error_from_a_common_mount_error():
    bias, mean = np.array([0, 0.8 * DEG, 0, 0, 0, 0]), np.array([0, 0.3 * DEG, 0, 0, 0, 0])
    line = make_line(100, 1.0, 2, bias=bias, mean=mean, witness_sigma=0.2 * DEG)
    model, found = answers(line)
    elevation = shared_errors(model, shared_axes("lidar_radar", np.eye(3)))[0]
    assert elevation.told
    assert elevation.value == pytest.approx(0.8 * DEG, rel=0.15)
    assert model.mean[1] == pytest.approx(0.3 * DEG, abs=0.06 * DEG)
    off = found.change[:, 1] - line.mounts[:, 1]
    assert np.abs(off.mean()) < 0.1 * DEG
    assert (sigmas(found)[:, 1] < 0.1 * DEG).all()


def test_remounted_vehicles_tell_a_shared_error_from_a_common_mount_error():
    bias, mean = np.array([0, 0.8 * DEG, 0, 0, 0, 0]), np.array([0, -0.4 * DEG, 0, 0, 0, 0])
    drawing = np.array([0.3 * DEG] * 3 + [0.02] * 3)
    line = make_line(120, 0.5, 5, bias=bias, mean=mean, remounted=30, drawing=drawing)
    model, _ = answers(line)
    sigma = np.sqrt(model.covariance[7, 7])
    assert sigma < 0.08 * DEG
    assert model.mean[7] == pytest.approx(0.8 * DEG, abs=3 * sigma)
    assert model.mean[1] == pytest.approx(-0.4 * DEG, abs=3 * sigma)


@pytest.mark.parametrize("stated_deg", [0.05, 0.2])
def test_a_shared_error_beyond_what_records_state_is_neither_shrunk_nor_moved_into_mounts(stated_deg):
    axes = {"radar elevation": shared_axes("lidar_radar", np.eye(3))["radar elevation"]}
    drawing, bias = np.array([0.3 * DEG] * 3 + [0.02] * 3), np.array([0, 0.8 * DEG, 0, 0, 0, 0])
    stated, z, moved = np.diag([(stated_deg * DEG) ** 2] * 3 + [0.01**2] * 3), [], []
    for seed in range(8):
        line = make_line(120, 0.5, seed, bias=bias, remounted=30, drawing=drawing)
        prior = LinePrior(np.diag(drawing**2), stated)
        shrunk = learn_line(line.evidence, prior)
        model = learn_line(line.evidence, widened(shrunk, axes))
        [before], [error] = (shared_errors(m, axes) for m in (shrunk, model))
        assert abs(before.value) < 0.95 * abs(error.value)
        assert error.told
        z.append((abs(error.value) - 0.8 * DEG) / error.sigma)
        moved.append(np.mean(with_line(model, line.evidence, line.common).change[30:, 1]) / DEG)
    assert np.abs(np.mean(z)) < 1.0
    assert np.sqrt(np.mean(np.square(z))) < 1.5
    assert np.abs(np.mean(moved)) < 0.08


def test_a_prior_is_not_widened_by_errors_as_large_as_stated_nor_by_what_no_data_tell_apart():
    axes = shared_axes("lidar_radar", np.eye(3))
    turns = {
        name: axes[name] for name in ("radar elevation", "radar azimuth")
    }  # not told apart by 30 vehicles
    for seed in range(12):
        rng = np.random.default_rng([seed, 9])
        drawing = np.array([0.3 * DEG] * 3 + [0.02] * 3)
        prior = LinePrior(np.diag(drawing**2), np.diag(COMMON**2))
        line = make_line(120, 0.5, seed, bias=COMMON * rng.normal(size=6), remounted=30, drawing=drawing)
        assert widened(model := learn_line(line.evidence, prior), turns) is model.prior
        far = make_line(120, 0.5, seed, bias=np.array([0, 0.8 * DEG, 0, 0, 0, 0]))
        assert widened(model := learn_line(far.evidence, PRIOR), axes) is model.prior


def test_drives_in_both_directions_tell_an_error_that_turns_with_the_vehicle():
    rng = np.random.default_rng(0)
    line = make_line(60, 1.0, 7)
    b = 0.3 * DEG
    ahead = line.mounts + LABELS * 0 + NOISE * rng.normal(size=(60, 6))
    back = line.mounts + NOISE * rng.normal(size=(60, 6))
    ahead[:, 2] += b
    back[:, 2] -= b
    noise = np.zeros((60, 12, 12))
    noise[:, :6, :6] = noise[:, 6:, 6:] = np.diag(NOISE**2)
    turn = np.eye(6)[:, 2:3]
    evidence = replace(
        line.evidence, value=np.hstack([ahead, back]), information=np.linalg.inv(noise),
        to_mount=np.vstack([np.eye(6), np.eye(6)]), to_bias=np.vstack([turn, -turn]),
    )  # fmt: skip
    model = learn_line(evidence, LinePrior(line.prior.mount, np.array([[b**2]])))
    assert model.mean[6] == pytest.approx(b, abs=3 * np.sqrt(model.covariance[6, 6]))
    assert np.sqrt(model.covariance[6, 6]) < 0.05 * b


def test_no_answer_hangs_on_any_one_vehicle():
    for scatter in (0.0, 0.5, 2.0):
        line = make_line(100, scatter, 11, bias=LABELS)
        model, found = answers(line)
        stated = largest_change_without_one(model, line.evidence, line.common)
        assert stated < 0.2
        tried = 0.0
        for j in range(0, 100, 10):
            rest = np.arange(100) != j
            other = with_line(learn_line(line.evidence.at(rest), line.prior), line.evidence, line.common)
            change = np.abs(other.change - found.change)[rest] / sigmas(found)[rest]
            tried = max(tried, float(change.max()))
        assert tried < max(1.3 * stated, 0.02)


@pytest.mark.parametrize("size_deg", [1.0, 2.0])
def test_a_vehicle_outside_its_line_is_named_and_answers_as_alone(size_deg):
    line = make_line(100, 0.5, 13)
    knock = np.array([size_deg * DEG, 0, 0, 0, 0, 0])
    value = line.evidence.value.copy()
    value[7] += knock
    evidence = replace(line.evidence, value=value)
    model = learn_line(evidence, line.prior)
    found = with_line(model, evidence, line.common)
    assert found.distance[7] > DIFFERS_SIGMAS
    assert found.axis[7] == 0
    assert not found.shared[7]
    alone, own = evidence.alone(line.prior)
    np.testing.assert_array_equal(found.change[7], alone[7])
    np.testing.assert_allclose(found.covariance[7], own[7] + line.common[7])
    assert np.sum(found.distance > DIFFERS_SIGMAS) <= 2
    others = np.arange(100) != 7
    without = with_line(learn_line(line.evidence.at(others), line.prior), evidence, line.common)
    moved = np.abs(without.change - found.change)[others] / sigmas(found)[others]
    assert moved.max() < 0.05


def test_a_line_moves_no_axis_by_more_than_a_sigma_of_the_vehicle_alone():
    line = make_line(100, 0.2, 17)
    _, found = answers(line)
    alone = np.sqrt(NOISE**2 + COMMON**2)
    moved = np.abs(found.change - line.evidence.alone(line.prior)[0])
    assert (moved <= alone * (1 + 1e-9))[found.shared].all()


def test_two_or_five_vehicles_are_no_line():
    line = make_line(5, 1.0, 1)
    with pytest.raises(ValueError, match="5 vehicles, a line needs 6"):
        learn_line(line.evidence, line.prior)


def test_few_vehicles_share_less_than_many():
    def sigma(vehicles):
        line = make_line(vehicles, 0.0, 23)
        own = np.einsum("nmm->nm", answers(line)[1].covariance) - COMMON**2
        return float(np.sqrt(np.mean(own / NOISE**2)))

    assert sigma(8) > 1.1 * sigma(100)


@pytest.mark.parametrize("vehicles", [50, 100])
def test_two_rigs_under_one_name_contradict_each_other(vehicles):
    line = make_line(vehicles, 0.5, 29)
    assert contradiction_of(line.evidence, learn_line(line.evidence, line.prior)) is None
    value = line.evidence.value.copy()
    value[::2, 1] += 0.6 * DEG
    evidence = replace(line.evidence, value=value)
    found = contradiction_of(evidence, learn_line(evidence, line.prior))
    assert found is not None
    assert (found.kind, found.axis, found.vehicles) == ("two groups", 1, vehicles // 2)


def test_many_vehicles_outside_contradict_a_line():
    line = make_line(100, 0.5, 31)
    value = line.evidence.value.copy()
    value[:15, 1] += np.linspace(0.7, 3, 15) * DEG
    evidence = replace(line.evidence, value=value)
    found = contradiction_of(evidence, learn_line(evidence, line.prior))
    assert found is not None
    assert found.kind == "many outside"
    assert found.vehicles >= 10


def test_evenly_spread_mounts_are_no_contradiction():
    rng = np.random.default_rng(3)
    for _ in range(20):
        line = make_line(100, 0.0, 37)
        value = line.evidence.value.copy()
        value[:, 0] += rng.uniform(-1, 1, 100) * DEG
        evidence = replace(line.evidence, value=value)
        assert contradiction_of(evidence, learn_line(evidence, line.prior)) is None


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_a_part_of_a_line_that_moves_is_told_from_the_whole(share):
    rng = np.random.default_rng(5)
    covariance = np.broadcast_to(np.diag(NOISE**2), (100, 6, 6))
    seen = np.ones((100, 6), bool)
    still = NOISE * rng.normal(size=(100, 6))
    assert motion_of(still, covariance, seen).kind == "none"
    all_move = still + np.array([0, 0.3 * DEG, 0, 0, 0, 0])
    whole = motion_of(all_move, covariance, seen)
    assert (whole.kind, whole.axis) == ("whole", 1)
    assert whole.size == pytest.approx(0.3 * DEG, abs=0.03 * DEG)
    part = motion_of(np.where((rng.random(100) < share)[:, None], all_move, still), covariance, seen)
    assert (part.kind, part.axis) == ("part", 1)


def test_an_axis_that_no_vehicle_determines_leaves_the_others_alone():
    line = make_line(50, 0.5, 41)
    information = line.evidence.information.copy()
    information[:, 5, 5] = 0.0
    evidence = replace(line.evidence, information=information)
    model = learn_line(evidence, line.prior)
    whole = learn_line(line.evidence, line.prior)
    np.testing.assert_allclose(model.variance[:5], whole.variance[:5], rtol=0.05, atol=1e-9)
    assert model.variance[5] == pytest.approx(DRAWING[5] ** 2)


def test_an_axis_of_which_rounding_alone_tells_scores_nothing():
    information = 1e6
    leak = 1e-9 * information
    # Rounding leaves a little less on the diagonal than the leaked row would need.
    W = np.array([[[0.9 * leak**2 / information, leak], [leak, information]]])
    residual = np.array([[0.0, 2 * DEG]])
    scores = shifts_in_sigmas(W, residual, np.eye(2), np.full((1, 2), 0.5 * DEG))
    np.testing.assert_allclose(scores, [[0.0, 2 * DEG * np.sqrt(information)]])


def test_four_times_the_vehicles_cost_about_four_times_as_much():
    def cost_s(vehicles):
        line = make_line(vehicles, 1.0, 43)
        begin = time.process_time()
        model, _ = answers(line)
        largest_change_without_one(model, line.evidence, line.common)
        return time.process_time() - begin

    cost_s(500)  # imports and caches
    assert cost_s(8000) < 10 * cost_s(2000)

"""Covariances, their common part, scenes and blocks of frames, and a day in two parts."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.calibrate.numerics.covariance import (
    bootstrap_covariance,
    covariance_with_fixed,
    posterior,
    response,
    widening,
)
from pipeline.calibrate.numerics.frame_blocks import (
    SCENE_DEGREES,
    Scenes,
    blocks_of,
    bootstrap_blocks,
    parts_of_day,
    scenes_of,
)
from pipeline.calibrate.select.frames import MIN_FRAMES, hold_out, select_frames
from pipeline.calibrate.verify.day_checks import MOVED_SIGMAS, PART_FLOOR_RAD, scene_failures
from pipeline.core.config import SelectConfig
from pipeline.rig.estimates import common_of, common_part, prior_share
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from tests.makers.solve_scenes import make_day


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


@pytest.mark.parametrize(
    ("block", "own", "least", "most"),
    [
        (np.repeat(np.arange(3), 10), 0.1, 0.9, 0.985),
        (np.repeat(np.arange(9), 10), 0.1, 0.9, 0.985),
        # Sixty frames of one view and forty of others: the estimate follows the one, whose residual is small for that.
        (np.r_[np.zeros(60, int), 1 + np.arange(40) // 2], 0.0, 0.93, 1.0),
    ],
)
def test_the_covariance_covers_the_truth_with_few_blocks_and_one_that_outweighs_the_day(
    block, own, least, most
):
    """Blocks whose frames err alike: within two sigmas as often as two sigmas say, however few they are."""
    z, blocks, frames = [], block.max() + 1, len(block)
    for seed in range(400):
        rng = np.random.default_rng([seed, blocks])
        noise = rng.normal(size=blocks)[block] + own * rng.normal(size=frames)
        g = (noise.mean() - noise)[:, None]
        covariance = bootstrap_covariance(np.ones((frames, 1, 1)), g, np.zeros((1, 1)), block, rng)
        z.append(noise.mean() / np.sqrt(covariance[0, 0]))
    assert least < np.mean(np.abs(z) < 1.96) < most


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


def test_no_direction_is_surer_than_the_information_nor_than_the_bias_floor():
    rng = np.random.default_rng(0)
    _, H, g, drive = linear_day(rng)
    found = bootstrap_covariance(H, 1e-6 * g, np.eye(2), drive, rng)
    assert np.linalg.eigvalsh(found - np.linalg.inv(H.sum(0) + np.eye(2))).min() > -1e-12
    floor = np.array([1, 2, 3, 4, 5, 6]) * 1e-3
    after = posterior(np.eye(6) * 1e-12, np.eye(6), floor)
    assert np.all(np.sqrt(np.diag(after.covariance)) >= floor)


def _covariance(rng, scale=1.0):
    A = rng.normal(size=(6, 9)) * np.array([1e-3] * 3 + [1e-2] * 3)[:, None]
    return scale * A @ A.T


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 100.0))
@settings(max_examples=40, deadline=None)
def test_what_is_left_without_the_common_part_is_a_covariance(seed, scale):
    rng = np.random.default_rng(seed)
    covariance = _covariance(rng)
    common = common_part(_covariance(rng, scale), covariance)
    unit = 1 / np.sqrt(np.diag(covariance))
    for part in (common, covariance - common):
        assert np.linalg.eigvalsh(part * np.outer(unit, unit)).min() > -1e-9


def test_what_stays_at_the_prior_is_the_same_every_day():
    prior = np.diag([1e-3] * 6)
    covariance = prior.copy()
    covariance[0, 0] = 1e-6  # one direction was determined by the day
    common = common_of(covariance, prior, np.zeros((6, 6)))
    np.testing.assert_allclose(np.diag(common)[1:], 1e-3)
    assert common[0, 0] == pytest.approx(1e-9)


def test_the_priors_share_is_the_scatter_that_its_error_gives_to_estimates():
    rng = np.random.default_rng(2)
    P0, R = _covariance(rng), _covariance(rng)
    C = np.linalg.inv(np.linalg.inv(P0) + np.linalg.inv(R))
    wrong = rng.multivariate_normal(np.zeros(6), P0, size=40_000)
    # The estimate of an exact measurement of 0 and a wrong prior.
    estimates = wrong @ (C @ np.linalg.inv(P0)).T
    predicted = prior_share(C, np.linalg.inv(P0))
    np.testing.assert_allclose(np.cov(estimates.T), predicted, atol=0.03 * np.diag(predicted).max())


NOISE_RAD = np.radians(0.3)  # of a frame


def measured(rng, frames, turn_rad, after):
    """What each frame says of three rotations."""
    values = rng.normal(0, NOISE_RAD, (frames, 3))
    values[after:] += turn_rad
    return values


def parts_of(values, scene=None):
    """Parts of a day whose frames each measure the rotation vector, each of its own scene or of a given one."""

    def solve(rows):
        mean = values[rows].mean(axis=0)
        T = from_rotation_translation(exp_so3(mean), np.zeros(3))
        return mean, T, np.eye(3) * NOISE_RAD**2 / len(rows)

    def score(mean):
        return -0.5 * np.sum((values - mean) ** 2, axis=1) / NOISE_RAD**2

    scene = np.arange(len(values)) if scene is None else scene
    stamps = [k * 10**9 for k in range(len(values))]
    return parts_of_day(values - values.mean(axis=0), stamps, solve, score, (0, 1, 2), scene)


@pytest.mark.parametrize("after", [9, 30, 51])
def test_a_step_is_found_where_it_is_and_as_large(after):
    turn = np.radians([0.0, 0.8, -0.4])
    for seed in range(5):
        parts = parts_of(measured(np.random.default_rng(seed), 60, turn, after))
        assert abs(parts.cut_ns[1] / 1e9 - after) <= 2
        assert parts.cut_ns[1] - parts.cut_ns[0] == 10**9
        sigma = np.sqrt(np.diag(parts.spread[0] + parts.spread[1]))
        np.testing.assert_array_less(np.abs(parts.step - turn), 4 * sigma)
        assert np.abs(parts.sigmas(PART_FLOOR_RAD)).max() > MOVED_SIGMAS


def test_quiet_days_are_never_called_moved():
    """Cut where they differ most, parts of quiet days differ by two or three sigmas; few by more."""
    found = [
        np.abs(parts_of(measured(np.random.default_rng(seed), 60, 0.0, 60)).sigmas(0.0)).max()
        for seed in range(200)
    ]
    assert np.mean(np.array(found) > MOVED_SIGMAS) < 0.005
    assert 1.5 < np.median(found) < 3.0


def test_a_cut_leaves_three_scenes_on_either_side():
    """Of the last street two scenes are left: that they agree says nothing of how sure they are."""
    values = measured(np.random.default_rng(2), 60, np.radians([0.0, 0.0, 2.0]), 50)
    scene = np.r_[np.arange(50), np.repeat([50, 51], 5)]
    parts = parts_of(values, scene)
    assert parts.cut_ns[1] / 1e9 <= 49
    assert parts_of(values, np.r_[np.zeros(30, int), np.ones(30, int)]) is None
    assert parts_of(values[:20], np.repeat(np.arange(4), 5)) is None


@pytest.fixture(scope="module")
def day():
    return make_day(40, per_drive=20)


def waiting(frame, count, since_s=0.0, step_s=0.5, speed_mps=0.0):
    """The same view again and again, measured anew: each edge some centimetres beside where it was."""
    rng = np.random.default_rng(3)
    xyz, noise = frame.lidar_edge_xyz_m, rng.normal(0, 0.02, (count, *frame.lidar_edge_xyz_m.shape))
    stamps_ns = frame.stamp_ns + ((since_s + step_s * np.arange(count)) * 1e9).astype(np.int64)
    return [
        replace(frame, frame_index=frame.frame_index + k, stamp_ns=int(stamps_ns[k]), ego_speed_mps=speed_mps,
                lidar_edge_xyz_m=xyz + noise[k].astype(np.float32))
        for k in range(count)
    ]  # fmt: skip


@pytest.mark.parametrize(("at", "count"), [(1, 1), (20, 60), (39, 7)])
def test_a_wait_at_a_light_is_one_scene_however_long(day, at, count):
    stop = waiting(day[at], count, since_s=0.01, step_s=0.9 / count)
    after = [replace(o, stamp_ns=o.stamp_ns + int(1e9)) for o in day[at + 1 :]]
    scene = scenes_of([*day[: at + 1], *stop, *after])
    assert scene.max() + 1 == 40
    assert np.all(scene[at + 1 : at + 1 + count] == scene[at])


@pytest.mark.parametrize("speed_mps", [0.0, None])
def test_the_same_view_of_another_drive_is_the_scene_that_it_was(day, speed_mps):
    first = waiting(day[0], 5, step_s=0.0, speed_mps=speed_mps)
    again = [replace(o, drive=7) for o in waiting(day[0], 5, since_s=3600.0, speed_mps=speed_mps)]
    scene = scenes_of([*first, *day[1:], *again])
    assert np.all(scene[-5:] == scene[0])
    assert len(np.unique(scene)) == 40


def test_every_street_is_a_scene_and_a_log_that_is_there_twice_adds_none_and_no_block(day):
    assert scenes_of(day).tolist() == list(range(40))
    shift_ns = int(7200e9)
    copied = [replace(o, stamp_ns=o.stamp_ns + shift_ns, drive=o.drive + 2) for o in day]
    assert len(np.unique(scenes_of([*day, *copied]))) == 40
    assert len(np.unique(blocks_of([*day, *copied]))) <= len(np.unique(blocks_of(day)))


def test_a_speed_that_says_zero_does_not_hide_a_drive(day):
    """An ambiguous Doppler wraps: at its period the car seems to stand, but its edges do not."""
    wrapped = [replace(o, ego_speed_mps=0.0, drive=0) for o in day]
    assert len(np.unique(scenes_of(wrapped))) >= 10
    assert len(np.unique(scenes_of(waiting(day[0], 40)))) == 1


@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_blocks_hold_whole_scenes_and_do_not_ask_for_their_names(seed):
    rng = np.random.default_rng(seed)
    scene = np.repeat(np.arange(30), rng.integers(1, 9, 30))
    drive = scene // 7
    block = bootstrap_blocks(drive, scene)
    assert all(len(np.unique(block[scene == s])) == 1 for s in range(30))
    names = rng.permutation(30)
    renamed = bootstrap_blocks(drive, names[scene])
    assert np.array_equal(np.equal.outer(block, block), np.equal.outer(renamed, renamed))


def test_a_view_judges_or_fits_as_a_whole(day):
    frames = [o for k, d in enumerate(day) for o in (waiting(d, 12, step_s=0.08) if k % 10 == 5 else [d])]
    held, scene = hold_out(frames, 0.2), scenes_of(frames)
    assert any(h is True for h in held)
    for s in np.unique(scene):
        assert not {True, False} <= {h for h, own in zip(held, scene, strict=True) if own == s}


def test_a_long_wait_does_not_outweigh_the_day(day):
    frames = [*day[:20], *waiting(day[19], 60, since_s=0.02, step_s=0.01), *day[20:]]
    chosen = select_frames(frames, SelectConfig(frames=100), paper=False)
    scene = scenes_of(frames)
    for pair, fit in chosen.fit.items():
        assert np.bincount(scene[fit]).max() <= MIN_FRAMES, pair
        assert len(fit) > 20


def test_a_day_of_one_scene_certifies_nothing_and_says_what_to_drive(day):
    standing = [
        replace(o, camera_stamp_ns=o.stamp_ns, radar_stamp_ns=o.stamp_ns) for o in waiting(day[0], 60)
    ]
    chosen = select_frames(standing, SelectConfig(), paper=False)
    for pair, fit in chosen.fit.items():
        (check,) = scene_failures([standing[i] for i in fit])
        assert check.fault == "few_scenes"
        assert "frames show 1, needs" in check.sentence
        assert any("drive some 100 m further" in what for what in chosen.missing[pair])
    assert scene_failures(day) == []


def scenes_of_equal(count, frames):
    return Scenes(*[np.repeat(np.arange(count), frames)] * 2)


@pytest.mark.parametrize(("correlation", "expected"), [(0.0, 1.0), (0.5, 2.5), (1.0, 4.0)])
def test_many_scenes_show_by_how_much_their_frames_err_together(correlation, expected):
    rng = np.random.default_rng(0)
    common, own = rng.normal(size=(400, 1, 3)), rng.normal(size=(400, 4, 3))
    gradient = (np.sqrt(correlation) * common + np.sqrt(1 - correlation) * own).reshape(-1, 3)
    assert scenes_of_equal(400, 4).inflation(gradient) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(("count", "correlation"), [(1, 0.6), (2, 0.1), (4, 0.6), (20, 0.6)])
def test_two_sigmas_of_few_scenes_hold_nineteen_of_twenty_values(count, correlation):
    """Days of one unknown, measured once a frame; what frames of a scene share is unknown to the estimate."""
    rng, frames, outside = np.random.default_rng(1), 8, 0
    scenes = scenes_of_equal(count, frames)
    for _ in range(300):
        shared = np.repeat(np.sqrt(correlation) * rng.normal(size=count), frames)
        measured = shared + np.sqrt(1 - correlation) * rng.normal(size=len(shared))
        gradient = (measured - measured.mean())[:, None]
        weight = len(shared) / scenes.scatter(gradient)
        g = weight * gradient
        information = scenes.inflation(g) * g[:, :, None] * g[:, None, :]
        prior = np.full((1, 1), 1e-6)
        variance = bootstrap_covariance(information, -g, prior, scenes.block, rng, 50, SCENE_DEGREES)
        outside += abs(measured.mean()) > 1.96 * np.sqrt(variance[0, 0])
    assert outside / 300 < 0.1

"""A sensor's pose from several days: it errs as its sigma states, and each source of information counts once."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.audit.fusion import LEAST_SCATTER, Mount, PoseDays, fuse
from pipeline.rig.se3 import change_between, change_covariance, change_jacobian, changed, exp_se3

PRIOR = np.diag([np.radians(2.0) ** 2] * 3 + [0.05**2] * 3)
NOISE = np.array([*np.radians([0.8, 0.1, 0.08]), 0.03, 0.03, 0.02])
BIAS = np.array([*np.radians([0.3, 0.05, 0.04]), 0.01, 0.01, 0.01])
SCATTER = np.array([*np.radians([0.03] * 3), 0.003, 0.003, 0.003])
STILL = Mount(np.full(6, 1e-6), np.zeros(6), 0.0)
ROLL = np.array([1.0, 0, 0, 0, 0, 0])


def left(T, C):
    """Covariance of changes as of the left perturbation."""
    K = np.linalg.inv(change_jacobian(T))
    return K @ C @ K.T


def day_of(T_day, T_prior, rng, shared, *, noise=NOISE, bias=BIAS):
    """One day's estimate with its prior: T, covariance, common, of a car that lies at T_day."""
    measured = changed(T_day, noise * rng.normal(size=6) + bias * shared)
    W = np.diag(1 / (noise**2 + bias**2))
    C = np.linalg.inv(W + np.linalg.inv(PRIOR))
    T = changed(T_prior, C @ W @ change_between(T_prior, measured))
    common = C @ W @ np.diag(bias**2) @ W @ C + C @ np.linalg.inv(PRIOR) @ C
    return T, left(T, C), left(T, common)


def days_of(count, rng, *, level=lambda _k: np.zeros(6), scatter=SCATTER, **errors):
    """Days of a car, and its true pose tomorrow."""
    truth = exp_se3(rng.normal(size=6) * [0.3, 0.3, 0.3, 0.5, 0.5, 0.5])
    T_prior = changed(truth, np.sqrt(np.diag(PRIOR)) * rng.normal(size=6))
    poses = [changed(changed(truth, level(k)), scatter * rng.normal(size=6)) for k in range(count + 1)]
    shared = rng.normal(size=6)
    rows = [day_of(T, T_prior, rng, shared, **errors) for T in poses[:-1]]
    T, C, B = (np.array(column) for column in zip(*rows, strict=True))
    priors = np.array([T_prior] * count), np.array([left(T_prior, PRIOR)] * count)
    return PoseDays(np.arange(1, count + 1), T, C, B, *priors), poses[-1]


def normalised(found, truth):
    """Error in its own sigmas, by degree of freedom."""
    sigma = np.sqrt(np.diag(change_covariance(found.T, found.covariance)))
    return change_between(found.T, truth) / sigma


@pytest.mark.parametrize("count", [1, 5, 20])
def test_tomorrows_pose_errs_as_its_sigma_states(count):
    rng = np.random.default_rng(count)
    mount = Mount(SCATTER, np.zeros(6), 0.0)
    z = []
    for _ in range(200):
        days, truth = days_of(count, rng)
        z.append(normalised(fuse(days, mount, count + 1), truth))
    assert np.sqrt(np.mean(np.square(z), axis=0)) == pytest.approx(np.ones(6), abs=0.17)


def test_what_varies_averages_down_and_what_is_common_does_not():
    rng = np.random.default_rng(3)
    sigma = {}
    for count in (1, 25):
        found = fuse(days_of(count, rng, scatter=np.zeros(6))[0], STILL, count + 1)
        sigma[count] = np.sqrt(np.diag(change_covariance(found.T, found.covariance)))
    before = np.sqrt(np.diag(PRIOR))
    expected = 1 / np.sqrt(1 / before**2 + 1 / (NOISE**2 / 25 + BIAS**2))
    assert sigma[25] == pytest.approx(expected, rel=0.03)
    assert np.all(sigma[1][:3] > 1.5 * sigma[25][:3])


@pytest.mark.parametrize(("scatter", "of_tomorrow"), [(0.0, 0.0), (0.9, 0.0), (3.0, np.sqrt(3.0**2 - 1))])
def test_scatter_that_days_are_said_to_err_by_alike_is_not_the_mount_s(scatter, of_tomorrow):
    """What is one thing counted twice left states of six nights unsure that days were sure of."""
    rng = np.random.default_rng(4)
    days, _ = days_of(25, rng, noise=0.1 * NOISE, scatter=np.zeros(6))
    found = fuse(days, Mount(np.hypot(LEAST_SCATTER, scatter * BIAS), np.zeros(6), 0.0), 26)
    variance = np.diag(change_covariance(found.T, found.covariance))
    level = BIAS**2 + scatter**2 * BIAS**2 / 25
    assert variance == pytest.approx(level + LEAST_SCATTER**2 + (of_tomorrow * BIAS) ** 2, rel=0.2)


def test_the_prior_counts_once_however_many_days_lean_on_it():
    rng = np.random.default_rng(4)
    days, truth = days_of(30, rng, noise=0.8 * np.sqrt(np.diag(PRIOR)), bias=np.zeros(6), scatter=np.zeros(6))
    found = fuse(days, STILL, 31)
    each = np.linalg.norm(change_between(truth, days.T)[:, :3], axis=1)
    assert np.linalg.norm(change_between(truth, found.T)[:3]) < 0.7 * np.median(each)
    assert np.abs(normalised(found, truth)).max() < 3.5


def test_an_axis_that_no_day_determines_stays_at_the_prior_to_the_last_digit():
    rng = np.random.default_rng(5)
    blind = np.where(ROLL, 1e6, NOISE)
    days, _ = days_of(6, rng, noise=blind, bias=np.zeros(6))
    found = fuse(days, STILL, 7)
    assert abs(change_between(days.T_prior[0], found.T)[0]) < 1e-9
    of_prior, whole = (np.diag(change_covariance(found.T, C)) for C in (found.of_prior, found.covariance))
    share = of_prior / whole
    assert share[0] == pytest.approx(1.0, abs=1e-3)
    assert share[1:3].max() < 0.1


def test_recent_days_weigh_more_where_mounts_wander():
    rng = np.random.default_rng(6)
    walk = np.zeros(6)
    walk[2] = np.radians(0.06) ** 2
    fixed, moving = Mount(SCATTER, np.zeros(6), 0.0), Mount(SCATTER, walk, 0.0)
    errors, z = [], []
    for _ in range(150):
        steps = np.cumsum(np.sqrt(walk) * rng.normal(size=(31, 6)), axis=0)
        days, truth = days_of(30, rng, level=lambda k, steps=steps: steps[k], bias=np.zeros(6))
        found = [fuse(days, mount, 31) for mount in (fixed, moving)]
        errors.append([change_between(f.T, truth)[2] for f in found])
        z.append(normalised(found[1], truth)[2])
    apart = np.sqrt(np.mean(np.square(errors), axis=0))
    assert apart[1] < 0.85 * apart[0]
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.2)


def test_days_before_a_knock_do_not_count():
    rng = np.random.default_rng(7)
    knock = np.radians([0.0, 0.0, 0.6, 0.0, 0.0, 0.0])
    days, truth = days_of(7, rng, level=lambda k: knock * (k >= 4), noise=NOISE / 3)
    found = fuse(days, Mount(SCATTER, np.zeros(6), 0.0), 8)
    assert (found.rows, found.moved_on, found.left_out) == ((4, 5, 6), 5, ())
    assert np.abs(normalised(found, truth)).max() < 3.5


def test_a_single_day_apart_is_left_out_and_the_days_before_it_count():
    rng = np.random.default_rng(9)
    astray = np.radians([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    days, _ = days_of(7, rng, level=lambda k: astray * (k == 3), noise=NOISE / 3)
    found = fuse(days, Mount(SCATTER, np.zeros(6), 0.0), 8)
    assert (found.rows, found.left_out, found.moved_on) == ((0, 1, 2, 4, 5, 6), (3,), None)


def test_a_step_that_the_days_do_not_prove_makes_tomorrow_less_sure():
    sigma = []
    for knock_deg in (0.0, 0.35):
        days, _ = days_of(6, np.random.default_rng(11), bias=np.zeros(6), scatter=np.zeros(6))
        last = changed(days.T[-1], np.array([0.0, 0.0, np.radians(knock_deg), 0.0, 0.0, 0.0]))
        unclear = replace(days, T=np.concatenate([days.T[:-1], last[None]]))
        found = fuse(unclear, Mount(SCATTER, np.zeros(6), 0.0), 7)
        assert len(found.rows) == 6
        sigma.append(np.degrees(np.sqrt(found.covariance[2, 2])))
    assert sigma[1] > 1.2 * sigma[0]

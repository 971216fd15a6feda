"""The part of a day's covariance that all days of a vehicle err by alike."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.rig.common_share import common_of, common_part, prior_share


def _covariance(rng: np.random.Generator, scale: float = 1.0) -> np.ndarray:
    A = rng.normal(size=(6, 9)) * np.array([1e-3] * 3 + [1e-2] * 3)[:, None]
    return scale * A @ A.T


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 100.0))
@settings(max_examples=40, deadline=None)
def test_what_is_left_without_the_common_part_is_a_covariance(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    covariance = _covariance(rng)
    common = common_part(_covariance(rng, scale), covariance)
    unit = 1 / np.sqrt(np.diag(covariance))
    for part in (common, covariance - common):
        assert np.linalg.eigvalsh(part * np.outer(unit, unit)).min() > -1e-9


def test_what_stays_at_the_prior_is_the_same_every_day() -> None:
    prior = np.diag([1e-3] * 6)
    covariance = prior.copy()
    covariance[0, 0] = 1e-6  # one direction was determined by the day
    common = common_of(covariance, prior, np.zeros((6, 6)))
    np.testing.assert_allclose(np.diag(common)[1:], 1e-3)
    assert common[0, 0] == pytest.approx(1e-9)


def test_the_priors_share_is_the_scatter_that_its_error_gives_to_estimates() -> None:
    rng = np.random.default_rng(2)
    P0, R = _covariance(rng), _covariance(rng)
    C = np.linalg.inv(np.linalg.inv(P0) + np.linalg.inv(R))
    wrong = rng.multivariate_normal(np.zeros(6), P0, size=40_000)
    # The estimate of an exact measurement of 0 and a wrong prior.
    estimates = wrong @ (C @ np.linalg.inv(P0)).T
    predicted = prior_share(C, np.linalg.inv(P0))
    np.testing.assert_allclose(np.cov(estimates.T), predicted, atol=0.03 * np.diag(predicted).max())

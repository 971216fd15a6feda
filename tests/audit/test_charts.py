"""The charts: their false alarms, their power, their start days."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.audit.charts import (
    Chart,
    alarm_threshold,
    judge_chart,
    pooled_scatter,
    ramp_fits,
    start_interval,
    step_scan,
)

PROBABILITY = 1e-3 / 18  # one chart's share of one false alarm in 1000 vehicle-days over 18 charts


def _chart(value: np.ndarray, sigma: np.ndarray | float = 1.0, day: np.ndarray | None = None) -> Chart:
    days = np.arange(len(value)) if day is None else day
    return Chart(
        days, np.asarray(value, float), np.broadcast_to(np.asarray(sigma, float), np.shape(value)).copy()
    )


@pytest.mark.parametrize("days", [2, 4, 28])
def test_false_alarms_stay_within_the_budget_and_do_not_waste_it(days: int) -> None:
    rng = np.random.default_rng(days)
    sigma = rng.uniform(0.5, 2.0, days)
    probability, trials = 0.02, 6000
    threshold = alarm_threshold(sigma, probability)
    noise = rng.normal(size=(trials, days)) * sigma
    alarms = np.mean([np.abs(step_scan(_chart(v, sigma))).max() > threshold for v in noise])
    spread = np.sqrt(probability * (1 - probability) / trials)
    assert alarms <= probability + 3 * spread
    assert alarms >= 0.75 * probability - 3 * spread  # a bound that wastes the budget costs power


def test_the_threshold_lies_between_one_test_and_bonferroni() -> None:
    from scipy.stats import norm

    for days in (3, 10, 200):
        threshold = alarm_threshold(np.ones(days), PROBABILITY)
        assert norm.isf(PROBABILITY / 2) < threshold < norm.isf(PROBABILITY / 2 / (days - 1))


@given(st.integers(2, 12), st.floats(-1e3, 1e3), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_the_scan_does_not_care_where_zero_lies(days: int, offset: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    value, sigma = rng.normal(size=days), rng.uniform(0.5, 2, days)
    np.testing.assert_allclose(
        step_scan(_chart(value + offset, sigma)), step_scan(_chart(value, sigma)), atol=1e-8
    )


@given(st.integers(3, 10), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_the_squared_scan_is_the_likelihood_gain_of_a_step(days: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    value, sigma = rng.normal(size=days), rng.uniform(0.5, 2, days)
    w = sigma**-2

    def chi2(v: np.ndarray, w: np.ndarray) -> float:
        return float(w @ (v - (w @ v) / w.sum()) ** 2)

    gains = [chi2(value, w) - chi2(value[:k], w[:k]) - chi2(value[k:], w[k:]) for k in range(1, days)]
    np.testing.assert_allclose(step_scan(_chart(value, sigma)) ** 2, gains, atol=1e-9)


def test_a_knock_on_the_third_of_four_days_is_found_with_its_day_and_size() -> None:
    rng = np.random.default_rng(3)
    found, right_day, sizes = 0, 0, []
    for _ in range(400):
        value = rng.normal(size=4) * 0.05 + np.array([0, 0, 0.5, 0.5])
        verdict = judge_chart(_chart(value, 0.05), 0.25, PROBABILITY, 2)
        if verdict.status == "RED":
            assert verdict.change is not None
            found += 1
            right_day += verdict.change.day == 2
            sizes.append((verdict.change.size - 0.5) / verdict.change.size_sigma)
    assert found >= 396
    assert right_day >= 0.99 * found
    assert abs(np.mean(sizes)) < 0.15
    assert 0.85 < np.std(sizes) < 1.15


@pytest.mark.parametrize(("days", "first", "size"), [(4, 2, 6.0), (10, 5, 4.0), (28, 20, 3.0)])
def test_the_start_interval_holds_the_true_day(days: int, first: int, size: float) -> None:
    rng = np.random.default_rng(days)
    trials, held = 1500, 0
    for _ in range(trials):
        value = rng.normal(size=days)
        value[first:] += size
        _, earliest, latest = start_interval(step_scan(_chart(value)) ** 2, np.arange(days))
        held += earliest <= first <= latest
    assert held / trials >= 0.95


def test_missing_days_widen_the_start_interval() -> None:
    chart = _chart(np.array([0, 0, 0, 9.0, 9, 9]), 1.0, np.array([1, 2, 3, 8, 9, 10]))
    assert start_interval(step_scan(chart) ** 2, chart.day) == (8, 4, 8)


def test_slow_drift_and_step_are_told_apart() -> None:
    rng = np.random.default_rng(5)
    kinds = {"step": [], "slow drift": []}
    for _ in range(200):
        day = np.arange(20)
        step, drift = np.where(day >= 10, 8.0, 0.0), np.maximum(day - 7, 0.0) * 0.8
        for truth, shape in (("step", step), ("slow drift", drift)):
            change = judge_chart(_chart(shape + rng.normal(size=20)), 1.0, PROBABILITY, 2).change
            assert change is not None
            kinds[truth].append(change.kind)
    assert kinds["step"].count("step") >= 196
    assert kinds["slow drift"].count("slow drift") >= 190


def test_a_drift_fit_recovers_its_size() -> None:
    day = np.array([0, 1, 2, 3, 5, 8, 9])
    value = np.maximum(day - 2, 0) * 0.1 + 4.0
    gain, size, sigma = ramp_fits(_chart(value, 0.01, day))
    best = int(np.argmax(gain))
    assert best == 2
    assert size[best] == pytest.approx(0.7, abs=1e-9)
    assert sigma[best] < 0.02


def test_one_bad_day_is_yellow_and_not_a_lasting_change() -> None:
    for values in ([0, 0, 14, 0, 0, 0], [0, 0, 0, 0, 0, 9]):
        verdict = judge_chart(_chart(np.array(values)), 1.0, PROBABILITY, 2)
        assert verdict.status == "YELLOW"
        assert "one day stands out" in verdict.reason


def test_a_sure_change_below_the_limit_is_yellow() -> None:
    verdict = judge_chart(_chart(np.array([0, 0, 0, 0.2, 0.2, 0.2]), 0.01), 0.25, PROBABILITY, 2)
    assert verdict.status == "YELLOW"
    assert "below" in verdict.reason


def test_green_is_only_said_where_a_change_of_the_limit_would_be_seen() -> None:
    seeing = judge_chart(_chart(np.zeros(4), 0.1), 0.25, PROBABILITY, 2)
    blind = judge_chart(_chart(np.zeros(4), 0.3), 0.25, PROBABILITY, 2)
    assert (seeing.status, blind.status) == ("GREEN", "UNKNOWN")
    assert "could hide" in blind.reason


@pytest.mark.parametrize("sigma", [0.13, 0.2, 0.31])
@pytest.mark.parametrize("days", [3, 4, 9])
def test_a_chart_that_cannot_tell_yet_says_after_how_many_days_it_can(sigma: float, days: int) -> None:
    blind = judge_chart(_chart(np.zeros(days), sigma), 0.25, PROBABILITY, 2)
    if blind.status == "GREEN":
        assert days >= 9  # only then is the sigma small enough
        return
    needed = int(re.search(r"after about (\d+) days", blind.reason)[1])
    # An odd number of days splits unevenly, three of them by an eighth of sigma squared: "about".
    assert judge_chart(_chart(np.zeros(needed + 1), sigma), 0.25, PROBABILITY, 2).status == "GREEN"
    assert judge_chart(_chart(np.zeros(int(0.8 * needed)), sigma), 0.25, PROBABILITY, 2).status == "UNKNOWN"


def test_what_looks_like_a_change_but_is_not_sure_is_not_called_green() -> None:
    verdict = judge_chart(_chart(np.array([0.0, 0.0, 0.36, 0.36]), 0.1), 0.25, PROBABILITY, 2)
    assert (verdict.status, verdict.change) == ("UNKNOWN", None)
    assert "may have begun" in verdict.reason


@pytest.mark.parametrize("days", [0, 1, 2])
def test_too_few_days_are_unknown(days: int) -> None:
    assert judge_chart(_chart(np.zeros(days), 0.01), 0.25, PROBABILITY, 2).status == "UNKNOWN"


def test_a_threshold_needs_two_days_and_a_probability() -> None:
    for sigma, probability in ((np.ones(1), 0.1), (np.ones(3), 0.0), (np.ones(3), 1.0)):
        with pytest.raises(ValueError, match="no threshold"):
            alarm_threshold(sigma, probability)


def test_scatter_is_pooled_over_the_fleet_and_never_shrinks_sigmas() -> None:
    rng = np.random.default_rng(7)
    wide = [_chart(rng.normal(size=30) * 2.0) for _ in range(10)]
    tight = [_chart(rng.normal(size=30) * 0.2) for _ in range(10)]
    assert pooled_scatter(wide) == pytest.approx(2.0, rel=0.15)
    assert pooled_scatter(tight) == 1.0
    knocked = [_chart(np.where(np.arange(30) > 14, 50.0, 0.0) + rng.normal(size=30)) for _ in range(10)]
    assert pooled_scatter(knocked) < 1.25
    assert pooled_scatter([]) == 1.0

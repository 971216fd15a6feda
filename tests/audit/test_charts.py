"""The charts: their false alarms, their power, their start days."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.audit.changes import start_interval
from pipeline.audit.charts import Charts, alarm_threshold, clipped, thresholds
from pipeline.audit.noise import Noise, estimate_noise
from pipeline.audit.scan import scan, scan_by
from pipeline.audit.verdicts import judge_charts
from pipeline.audit.wander import with_wander

PROBABILITY = 1e-3 / 18  # one chart's share of one false alarm in 1000 vehicle-days over 18 charts
BUDGET = np.array([[PROBABILITY], [20 * PROBABILITY]])  # of RED, of YELLOW


def _charts(values, sigma=1.0, day=None, accepted=None, reference_days=0):
    rows = [np.asarray(v, float) for v in values]
    N = max(1, *(len(v) for v in rows))
    out = Charts(
        np.zeros((len(rows), N), np.int64), np.zeros((len(rows), N)), np.full((len(rows), N), np.inf),
        np.ones((len(rows), N), bool), np.full(len(rows), reference_days), np.array([len(v) for v in rows]),
    )  # fmt: skip
    for m, v in enumerate(rows):
        days = np.arange(len(v)) if day is None else day
        out.day[m], out.day[m, : len(v)] = days[-1] if len(v) else 0, days
        out.value[m, : len(v)] = v
        out.sigma[m, : len(v)] = sigma
        if accepted is not None:
            out.accepted[m] = accepted
    return out


def _known(charts: Charts, autocorrelation: float = 0.0) -> Noise:
    """Noise as the sigmas say it, known for sure."""
    M = len(charts.count)
    return Noise(np.ones(M), np.full(M, 1e6), np.full(M, autocorrelation), np.zeros(M), np.zeros(M))


def _judge(value, limit, sigma=1.0, **chart):
    charts = _charts([np.asarray(value)], sigma, **chart)
    return judge_charts(charts, _known(charts), np.array([limit]), BUDGET, 2)[0]


def _z(charts: Charts, autocorrelation: float = 0.0) -> np.ndarray:
    M = len(charts.count)
    return scan(charts, charts.value, np.ones(M), np.full(M, autocorrelation)).z


@pytest.mark.parametrize("days", [2, 4, 28])
def test_false_alarms_stay_within_the_budget_and_do_not_waste_it(days: int):
    rng = np.random.default_rng(days)
    sigma = rng.uniform(0.5, 2.0, days)
    probability, trials = 0.02, 6000
    threshold = alarm_threshold(sigma, probability)
    z = _z(_charts(rng.normal(size=(trials, days)) * sigma, sigma))
    alarms = np.mean(np.abs(z).max(axis=1) > threshold)
    spread = np.sqrt(probability * (1 - probability) / trials)
    assert alarms <= probability + 3 * spread
    assert alarms >= 0.75 * probability - 3 * spread  # a bound that wastes the budget costs power


def test_a_scale_that_is_hardly_known_needs_more_sigmas():
    found = thresholds(
        np.array([10, 10, 1]), np.array([8.0, 1e9, 8.0]), np.full(3, PROBABILITY), np.zeros(3), "step"
    )
    assert found[0] > found[1] + 1
    surely = alarm_threshold(np.ones(10), PROBABILITY)
    assert found[1] == pytest.approx(surely, rel=0.04)  # 200 are taken for sure
    assert np.isinf(found[2])


@pytest.mark.parametrize("phi", [0.0, 0.6, 0.9])
@pytest.mark.parametrize("reference_days", [0, 10])
@pytest.mark.parametrize("wander", [0.0, 0.09])
def test_steps_and_drifts_are_least_squares_through_ar1_days_with_gaps_about_a_level_that_wanders(
    phi: float, reference_days: int, wander: float
):
    rng = np.random.default_rng(5)
    day, sigma, value = np.array([0, 1, 2, 5, 6, 9, 10]), rng.uniform(0.5, 2, 7), rng.normal(size=7) + 100
    charts = _charts([value, value[:3]], 1.0, None, None, reference_days)
    charts.day[0], charts.day[1], charts.sigma[0] = day, [0, 1, 2, 2, 2, 2, 2], sigma
    found = scan(charts, charts.value, np.array([1.5, 1.0]), np.full(2, phi), np.full(2, wander))
    # A day that is less sure than most errs for reasons of its own; a reference is a mean of days long ago.
    days = sigma[reference_days > 0 :]
    h = np.minimum(sigma, np.sort(days)[(len(days) - 1) // 2])
    own = sigma**2 - h**2
    if reference_days:
        lag = np.arange(1, 10)
        h[0], own[0] = 0, sigma[0] ** 2 * (1 + 2 * ((1 - lag / 10) * phi**lag).sum())
    walk = wander / 1.5**2 * np.minimum.outer(day, day)
    walk[0, 0] += wander / 1.5**2 * reference_days / 3
    W = np.linalg.inv(phi ** np.abs(day[:, None] - day[None]) * np.outer(h, h) + np.diag(own) + walk)
    for s in range(6):
        for shape, size, error in (
            ((np.arange(7) > s).astype(float), found.size, found.sigma),
            (np.maximum(day - day[s], 0) / (day[-1] - day[s]), found.drift, found.drift_sigma),
        ):
            X = np.stack([np.ones(7), shape], axis=1)
            covariance = np.linalg.inv(X.T @ W @ X)
            assert size[0, s] == pytest.approx((covariance @ X.T @ W @ value)[1])
            assert error[0, s] == pytest.approx(1.5 * np.sqrt(covariance[1, 1]))
    assert np.isinf(found.sigma[1, 2:]).all()


@pytest.mark.parametrize("of", ["step", "drift"])
def test_false_alarms_of_days_that_err_alike_stay_within_the_budget(of: str):
    rng, trials, probability = np.random.default_rng(6), 4000, 0.02
    e = rng.normal(size=(trials, 20))
    for k in range(1, 20):
        e[:, k] = 0.6 * e[:, k - 1] + 0.8 * e[:, k]
    charts = _charts(e)
    found = scan(charts, e, np.ones(trials), np.full(trials, 0.6))
    z = np.abs(found.z if of == "step" else found.drift_z).max(axis=1)
    alarms = np.mean(z > alarm_threshold(np.ones(20), probability, 0.6, of))
    spread = np.sqrt(probability * (1 - probability) / trials)
    assert 0.6 * probability - 3 * spread <= alarms <= probability + 3 * spread


def test_where_the_autocorrelation_is_not_known_each_split_is_as_sure_as_by_the_worse_of_both():
    rng = np.random.default_rng(7)
    charts = _charts(rng.normal(size=(3, 9)))
    low, high = _known(charts, 0.0), _known(charts, 0.6)
    either = scan_by(charts, charts.value, replace(high, less_alike=low))
    both = [scan_by(charts, charts.value, n) for n in (low, high)]
    z = [np.abs(found.z) for found in both]
    assert (z[0] < z[1]).any()
    assert (z[1] < z[0]).any()
    assert (np.abs(either.z) <= np.minimum(*z)).all()
    np.testing.assert_array_equal(either.sigma, np.maximum(both[0].sigma, both[1].sigma))
    np.testing.assert_array_equal(either.size, np.where(z[0] < z[1], both[0].size, both[1].size))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_one_day_alone_is_clipped_and_two_in_a_row_are_believed(seed: int):
    rng = np.random.default_rng(seed)
    at = int(rng.integers(0, 12))
    alone, lasting = rng.normal(size=12) * 0.3, rng.normal(size=12) * 0.3
    alone[at] += 50
    lasting[8:] += 50
    assert np.abs(clipped(_charts([alone]), np.ones(1))).max() < 5
    found = clipped(_charts([lasting]), np.ones(1))[0]
    np.testing.assert_allclose(found, lasting, atol=2.0)


def test_a_knock_on_the_third_of_four_days_is_found_with_its_day_and_size():
    rng = np.random.default_rng(3)
    found, right_day, sizes = 0, 0, []
    for _ in range(400):
        value = rng.normal(size=4) * 0.05 + np.array([0, 0, 0.5, 0.5])
        verdict = _judge(value, 0.25, 0.05)
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
def test_the_start_interval_holds_the_true_day(days: int, first: int, size: float):
    rng = np.random.default_rng(days)
    trials, held = 1500, 0
    for _ in range(trials):
        value = rng.normal(size=days)
        value[first:] += size
        _, earliest, latest = start_interval(_z(_charts([value]))[0] ** 2, np.arange(days))
        held += earliest <= first <= latest
    assert held / trials >= 0.95


def test_missing_days_widen_the_start_interval():
    charts = _charts([np.array([0, 0, 0, 9.0, 9, 9])], 1.0, np.array([1, 2, 3, 8, 9, 10]))
    assert start_interval(_z(charts)[0] ** 2, charts.day[0]) == (8, 4, 8)


def test_slow_drift_and_step_are_told_apart():
    rng = np.random.default_rng(5)
    kinds = {"step": [], "slow drift": []}
    for _ in range(200):
        day = np.arange(20)
        step, drift = np.where(day >= 10, 8.0, 0.0), np.maximum(day - 7, 0.0) * 0.8
        for truth, shape in (("step", step), ("slow drift", drift)):
            change = _judge(shape + rng.normal(size=20), 1.0).change
            assert change is not None
            kinds[truth].append(change.kind)
    assert kinds["step"].count("step") >= 196
    assert kinds["slow drift"].count("slow drift") >= 190


@pytest.mark.parametrize(
    ("values", "limit", "sigma", "status", "words"),
    [
        ([0, 0, 0, 0, 0, 9], 1.0, 0.5, "YELLOW", "one day differs"),
        ([0, 0, 0, 0, 0, 9, 9], 1.0, 0.5, "RED", ""),
        ([0, 0, 14, 0, 0, 0], 2.0, 0.5, "GREEN", ""),  # it did not last
        ([0] * 8 + [9] * 6 + [0] * 3, 1.0, 0.3, "GREEN", "back at the reference"),
        ([0] * 8 + [9] * 6 + [0], 1.0, 0.3, "RED", ""),  # one day is no repair yet
        ([0] * 8 + [9] * 14 + [15] * 3, 1.0, 0.3, "RED", ""),
        ([0, 0, 0, 0.2, 0.2, 0.2], 0.25, 0.01, "YELLOW", "below"),
        ([0, 0, 0.38, 0.38], 0.25, 0.1, "YELLOW", "may have begun"),
        ([0] * 10 + [0.3] * 4, 0.25, 0.08, "YELLOW", "may be above the limit"),
        ([0] * 10 + [0.3] * 4, 0.2, 0.08, "RED", ""),
        ([0] * 4, 0.25, 0.1, "GREEN", ""),
        ([0] * 4, 0.25, 0.3, "UNKNOWN", "below 34 deg would not be noticed yet (limit 14 deg); about 20 more"),
        ([], 1.0, 0.01, "UNKNOWN", ""),
        ([0, 0], 1.0, 0.01, "UNKNOWN", ""),
    ],
)  # fmt: skip
def test_a_chart_s_status_is_that_of_its_days(values, limit, sigma, status, words):
    verdict = _judge(np.array(values, float), limit, sigma)
    assert verdict.status == status
    assert words in verdict.reason
    assert (verdict.change is not None) == (status in ("RED", "YELLOW"))


def test_a_change_has_the_day_and_size_of_the_first_and_the_last_of_several():
    last = _judge([0, 0, 0, 0, 0, 9], 1.0, 0.5).change
    assert (last.day, last.size) == (5, 9.0)
    second = _judge([0.0] * 8 + [9.0] * 14 + [15.0] * 3, 1.0, 0.3).change
    assert (second.day, second.settled) == (8, 22)
    assert second.size == pytest.approx(15.0)


@pytest.mark.parametrize("days", [1, 30, 300])
def test_a_chart_off_its_reference_stays_red(days):
    assert _judge([0.0] + [9.0] * (days + 2), 1.0, 0.3, reference_days=8).status == "RED"


@pytest.mark.parametrize("sigma", [0.13, 0.2, 0.31])
@pytest.mark.parametrize("days", [3, 4, 9])
def test_a_chart_that_cannot_tell_yet_says_after_how_many_days_it_can(sigma: float, days: int):
    blind = _judge(np.zeros(days), 0.25, sigma)
    if blind.status == "GREEN":
        assert days >= 9  # only then is the sigma small enough
        return
    needed = days + blind.days_needed
    # An odd number of days splits unevenly, three of them by an eighth of sigma squared: "about".
    assert _judge(np.zeros(needed + 1), 0.25, sigma).status == "GREEN"
    assert _judge(np.zeros(int(0.8 * needed)), 0.25, sigma).status == "UNKNOWN"


def test_two_days_are_not_enough_where_single_days_are_often_far_off():
    charts = _charts([np.array([0.0] * 8 + [9.0] * after) for after in (2, 3)])
    known = _known(charts)
    for far, expected in ((0.003, ["RED", "RED"]), (0.02, ["YELLOW", "RED"])):
        noise = replace(known, far=np.full(2, far))
        verdicts = judge_charts(charts, noise, np.full(2, 1.0), np.full((2, 2), PROBABILITY), 2)
        assert [v.status for v in verdicts] == expected


def _fleet_noise(values: np.ndarray) -> Noise:
    """Of V vehicles with one pair of two DoF: values V 2 N."""
    return estimate_noise(_charts(values.reshape(-1, values.shape[-1])), (len(values), 1, 2))


def test_scatter_is_the_fleets_and_never_shrinks_sigmas():
    rng = np.random.default_rng(7)
    wide, tight = (_fleet_noise(rng.normal(size=(30, 2, 28)) * factor).scale for factor in (2.0, 0.2))
    assert np.median(wide) == pytest.approx(2.0, rel=0.1)
    np.testing.assert_array_equal(tight, 1.0)


def test_a_vehicle_whose_sigmas_are_too_small_is_told_from_its_fleet():
    rng = np.random.default_rng(8)
    values = rng.normal(size=(30, 2, 28))
    values[3] *= 1.8
    scale = _fleet_noise(values).scale.reshape(30, 2)
    assert scale[3].min() > 1.2
    assert np.median(scale) < 1.2


def test_real_steps_are_no_scatter():
    rng = np.random.default_rng(9)
    values = rng.normal(size=(10, 2, 30))
    values[..., 15:] += 50
    assert _fleet_noise(values).scale.max() < 1.6
    moving = np.arange(4) * 60.0 + rng.normal(size=(1, 2, 4))  # each day differs from the last: no noise
    assert _fleet_noise(moving).scale.max() < 3


@pytest.mark.parametrize("phi", [0.0, 0.3, 0.6])
def test_autocorrelation_is_found_and_is_not_taken_for_small_scatter(phi: float):
    rng = np.random.default_rng(10)
    e = rng.normal(size=(150, 2, 40))
    for k in range(1, 40):
        e[..., k] = phi * e[..., k - 1] + np.sqrt(1 - phi**2) * e[..., k]
    found = _fleet_noise(e)
    assert np.median(found.autocorrelation) == pytest.approx(phi, abs=0.08)
    assert np.median(found.scale) < 1.15


def test_scatter_is_learnt_by_model():
    rng = np.random.default_rng(12)
    values = rng.normal(size=(200, 2, 8)) * np.where(np.arange(200) < 100, 1.0, 2.0)[:, None, None]
    charts = _charts(values.reshape(-1, 8))
    together = estimate_noise(charts, (200, 1, 2)).scale.reshape(200, 2)
    apart = estimate_noise(charts, (200, 1, 2), ["van"] * 100 + ["car"] * 100).scale.reshape(200, 2)
    assert np.median(apart[:100]) < 0.95 * np.median(together[:100])
    assert np.median(apart[100:]) > 1.05 * np.median(together[100:])


def test_vehicles_that_are_alike_are_known_to_more_degrees_of_freedom_than_such_that_differ():
    rng = np.random.default_rng(14)
    values = rng.normal(size=(60, 2, 28))
    alike, differ = (
        _fleet_noise(values * f[:, None, None]) for f in (np.ones(60), np.exp(rng.normal(0, 0.4, 60)))
    )
    assert np.median(alike.freedom) > 2 * np.median(differ.freedom)


def test_what_begins_on_all_vehicles_at_once_is_no_scatter():
    rng = np.random.default_rng(15)
    values = rng.normal(size=(30, 2, 28))
    drifting = values + np.maximum(np.arange(28) - 21, 0) * 0.8
    still, moving = _fleet_noise(values), _fleet_noise(drifting)
    assert np.median(moving.scale) < 1.05 * np.median(still.scale)
    assert np.median(moving.autocorrelation) < np.median(still.autocorrelation) + 0.05


def test_a_change_that_stays_is_no_day_far_off():
    values = np.random.default_rng(10).normal(size=(1, 2, 8))
    quiet = _fleet_noise(values).far[0]
    stays, single = values.copy(), values.copy()
    stays[0, 0, 3:] += 50
    single[0, 0, 3] += 50
    assert _fleet_noise(stays).far[0] == pytest.approx(quiet)
    assert _fleet_noise(single).far[0] > 2 * quiet


def test_edges_of_a_fleet_are_as_often_far_off_as_the_one_that_is_most():
    values = np.random.default_rng(11).normal(size=(4, 6, 20))
    values[:, 0, 2:-2:5] += 30
    charts = _charts(values.reshape(24, 20))
    noise = estimate_noise(charts, (4, 6, 1))
    assert noise.heavy.all()
    assert len(np.unique(noise.far)) == 1


def test_a_change_that_may_have_begun_takes_more_where_few_days_say_how_they_scatter():
    verdicts = []
    for before in (2, 14):
        charts = _charts([np.array([0.0] * before + [0.4, 0.4])], 0.1)
        hardly = replace(_known(charts), freedom=np.full(1, 8.0))
        verdicts += judge_charts(charts, hardly, np.array([0.25]), BUDGET, 2)
    assert [v.status for v in verdicts] == ["GREEN", "YELLOW"]


def _swinging(vehicles: int, swing: float, moved: float = 0.0) -> tuple[Charts, Noise]:
    """Charts of one edge with two DoF, a reference and 28 days a month later, and what they are found to wander by."""
    rng = np.random.default_rng(11)
    values = 0.05 * rng.normal(size=(vehicles, 2, 29))
    values[..., 0] = 0.05 / np.sqrt(10) * rng.normal(size=(vehicles, 2))
    values[:, 0, 1:] += swing * rng.normal(size=(vehicles, 1)) + moved
    charts = _charts(values.reshape(-1, 29), 0.05, np.r_[0, np.arange(40, 68)], reference_days=10)
    charts.sigma[:, 0] = 0.05 / np.sqrt(10)
    shape = vehicles, 1, 2
    return charts, with_wander(charts, estimate_noise(charts, shape), np.full(2 * vehicles, 0.1), shape)


def test_what_all_vehicles_wander_by_over_weeks_is_learnt_by_axis():
    _, noise = _swinging(60, 0.03)
    turning, still = noise.wander.reshape(60, 2)[0]
    assert 0.02 < np.sqrt(50 * turning) < 0.04
    assert still < 0.1 * turning


@pytest.mark.parametrize("moved", [0.15, 0.3])
def test_a_fleet_that_moved_as_one_is_not_taken_to_wander(moved: float):
    _, noise = _swinging(60, 0.0, moved)
    assert noise.wander.max() == 0


def test_a_swing_that_all_vehicles_show_is_no_change_and_a_larger_change_is():
    charts, noise = _swinging(60, 0.03)
    still = replace(noise, wander=np.zeros(120), less_alike=None)
    charts.value[0, 1:] = 0.1 + 0.02 * np.random.default_rng(1).normal(size=28)
    charts.value[2, 1:] = 0.3 + 0.02 * np.random.default_rng(2).normal(size=28)
    probability = np.full((2, 120), PROBABILITY)
    found, strict = (judge_charts(charts, n, np.full(120, 0.05), probability, 2) for n in (noise, still))
    assert [strict[m].status for m in (0, 2)] == ["RED", "RED"]
    assert [found[m].status for m in (0, 2)] == ["GREEN", "RED"]


@pytest.mark.parametrize("size", [10.0, 40.0])
def test_a_day_far_off_explains_the_days_that_come_back_from_it_however_far_it_is(size: float):
    rng = np.random.default_rng(5)
    error = np.zeros((200, 11))
    for k in range(1, 11):
        error[:, k] = 0.6 * error[:, k - 1] + 0.8 * rng.normal(size=200)
    dying, lasting = error.copy(), error
    dying[:, 6:] += size * 0.6 ** np.arange(5)
    lasting[:, 6:] += size
    charts = _charts([*dying, *lasting])
    noise = replace(_known(charts, 0.6), far=np.full(400, 0.02))
    z = np.abs(scan_by(charts, charts.value, noise, noise.reach).z).max(axis=1)
    # A day counts for 3.5 sigmas, and chance for some more over the days; a step adds a part of itself every day.
    assert np.quantile(z[:200], 0.99) < 5.2
    assert np.quantile(z[200:], 0.1) > 5.2


@pytest.mark.parametrize(("far", "status"), [(0.0027, "YELLOW"), (0.02, "GREEN")])
def test_a_last_day_alone_stands_out_only_beyond_what_single_days_do(far: float, status: str):
    charts = _charts([np.array([0.0] * 14 + [8.0])])  # 5.7 sigmas of a difference of two days
    noise = replace(_known(charts), far=np.full(1, far))
    (verdict,) = judge_charts(charts, noise, np.full(1, 2.0), np.full((2, 1), 1e-3), 2)
    assert verdict.status == status


def test_a_value_back_at_its_reference_is_green_though_days_off_are_all_that_is_left_beside_it():
    rng = np.random.default_rng(5)
    value = np.r_[0.0, np.full(4, 0.9), np.zeros(20)] + 0.03 * rng.normal(size=25)
    charts = _charts([value], 0.1, np.r_[0, np.arange(40, 64)], reference_days=10)
    charts.sigma[0, 0] = 0.03
    wandering = replace(_known(charts, 0.6), wander=np.full(1, 0.002))
    (verdict,) = judge_charts(charts, wandering, np.full(1, 0.8), np.full((2, 1), PROBABILITY), 2)
    assert verdict.status == "GREEN"

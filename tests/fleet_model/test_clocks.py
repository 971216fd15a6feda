"""Time offsets of a model line: what is common, who differs, and steps of all of them."""

import numpy as np
import pytest

from pipeline.fleet_model.clocks import clock_step, line_clock, of_vehicles

MEAN, NIGHTS = 0.012, 8


def made_days(rng, vehicles=40, scatter=0.002, sigma=0.003, step=0.0, share=1.0, alike=0.0):
    """Vehicle, day, offset and its sigma of every night; the last three are stepped on a share of the vehicles."""
    own = MEAN + scatter * rng.normal(size=vehicles)
    error = rng.normal(size=vehicles)
    days = []
    for night in range(NIGHTS):
        error = alike * error + np.sqrt(1 - alike**2) * rng.normal(size=vehicles)
        stepped = step * (np.arange(vehicles) < share * vehicles) * (night >= NIGHTS - 3)
        days.append(own + sigma * error + stepped)
    of, day = np.tile(np.arange(vehicles), NIGHTS), np.repeat(np.arange(NIGHTS) + 739000, vehicles)
    return own, (of, day, np.concatenate(days), np.full(vehicles * NIGHTS, sigma))


@pytest.mark.parametrize(("scatter", "alike"), [(0.0, 0.0), (0.002, 0.0), (0.01, 0.0), (0.002, 0.6)])
def test_mean_and_scatter_of_a_line_are_found_within_their_sigmas(scatter, alike):
    off, scatters = [], []
    for seed in range(30):
        _, (of, _, value, sigma) = made_days(np.random.default_rng([1, seed]), scatter=scatter, alike=alike)
        _, mean, known = of_vehicles(of, value, sigma)
        clock = line_clock(mean, known)
        off.append((clock.mean - MEAN) / clock.sigma)
        scatters.append(clock.scatter)
        assert clock.distance.max() < 4.5
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 1.3
    # What the days of a vehicle err by alike, its mean cannot tell from where its clock is.
    days = 0.003 * np.sqrt((1 + alike) / (1 - alike) / NIGHTS - 1 / NIGHTS)
    assert np.median(scatters) == pytest.approx(np.hypot(scatter, days), rel=0.25, abs=0.0006)


def test_a_vehicle_with_another_offset_is_named_and_moves_the_line_by_nothing():
    _, (of, _, value, sigma) = made_days(np.random.default_rng(2))
    value = value + 0.05 * (of == 7)
    _, mean, known = of_vehicles(of, value, sigma)
    clock = line_clock(mean, known)
    others = line_clock(np.delete(mean, 7), np.delete(known, 7))
    assert np.flatnonzero(clock.distance > 3.9).tolist() == [7]
    assert abs(clock.mean - others.mean) < 0.2 * clock.sigma


@pytest.mark.parametrize(
    ("step", "share", "is_found"), [(0.01, 1.0, True), (0.01, 0.3, False), (0.0, 1.0, False)]
)
def test_a_step_is_the_line_s_where_nearly_all_vehicles_show_it(step, share, is_found):
    for seed in range(20):
        _, days = made_days(np.random.default_rng([3, seed]), step=step, share=share)
        found = clock_step(*days)
        assert (found is not None) == is_found
        if is_found:
            assert abs(found[0] - step) < 4 * found[1]


def test_five_vehicles_have_no_clock_in_common():
    _, (of, _, value, sigma) = made_days(np.random.default_rng(4), vehicles=5)
    assert line_clock(*of_vehicles(of, value, sigma)[1:]) is None

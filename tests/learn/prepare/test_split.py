"""No vehicle, day or place on two sides, whatever the fleet looks like; and what was decided stays."""

import itertools

import numpy as np
import pytest

from pipeline.learn.prepare.search import worth
from pipeline.learn.prepare.split import Unit, environment_of_speeds, plan_split
from schemas.training import SPLITS

ALL = ("vehicle", "day", "place")


def random_fleet(rng):
    """Vehicles, days and places that meet at random: sparse or dense."""
    vehicles, days, places = rng.integers(1, 9), rng.integers(1, 9), rng.integers(1, 12)
    count = rng.integers(1, 60)
    drawn = zip(
        rng.integers(vehicles, size=count),
        rng.integers(days, size=count),
        rng.integers(places, size=count),
        strict=True,
    )
    return [Unit(f"v{v}", f"d{d}", f"p{p}", int(rng.integers(1, 50))) for v, d, p in sorted(set(drawn))]


def sides(plan, units):
    return {u: plan.side_of(u.vehicle, u.day, u.place) for u in units}


@pytest.mark.parametrize("by", [ALL, ("vehicle",), ("place",), ("vehicle", "place"), ("day", "place")])
def test_no_key_is_on_two_sides(by):
    rng = np.random.default_rng(1)
    kept = 0
    for _ in range(150):
        units = random_fleet(rng)
        of = sides(plan_split(units, by, 0.15, 0.15), units)
        for kind in by:
            seen = {}
            for unit, side in of.items():
                if side is not None:
                    assert seen.setdefault(getattr(unit, kind), side) == side
                    kept += 1
    assert kept > 1000


def test_separate_groups_lose_no_frame_and_come_near_the_shares():
    units = [Unit(f"v{i}", f"d{i}", f"p{i}", 10) for i in range(50)]
    of = sides(plan_split(units, ALL, 0.1, 0.2), units)
    assert None not in of.values()
    share = {s: np.mean([side == s for side in of.values()]) for s in SPLITS}
    assert share == pytest.approx({"train": 0.7, "val": 0.1, "test": 0.2}, abs=0.021)


@pytest.mark.parametrize("count", [3, 4, 7])
def test_every_side_gets_something_where_there_is_enough(count):
    units = [Unit(f"v{i}", f"d{i}", "p", 100 if i == 0 else 1) for i in range(count)]
    assert set(sides(plan_split(units, ("vehicle", "day"), 0.1, 0.1), units).values()) == set(SPLITS)


def test_a_fleet_that_hangs_together_is_cut_with_all_sides_alive():
    units = [Unit(f"v{v}", f"d{d}", f"p{(v + d) % 5}") for v in range(12) for d in range(10)]
    of = sides(plan_split(units, ALL, 0.1, 0.1), units)
    counts = {s: sum(side == s for side in of.values()) for s in SPLITS}
    assert min(counts.values()) > 0
    assert counts["train"] > 2 * max(counts["val"], counts["test"])
    assert sum(counts.values()) < len(units)  # frames between the sides are lost: that is the price


def kept(units, assignments):
    """Frames that each side keeps (n 3) under assignments (n keys) of sides to the units' keys in order."""
    keys = sorted({key for unit in units for key in unit.keys(ALL)})
    frames = np.zeros((len(assignments), 3))
    for unit in units:
        own = assignments[:, [keys.index(key) for key in unit.keys(ALL)]]
        for side in range(3):
            frames[:, side] += unit.frames * (own == side).all(axis=1)
    return frames


def kept_by(plan, units):
    """The same of one plan (3)."""
    keys = sorted({key for unit in units for key in unit.keys(ALL)})
    return kept(units, np.array([[SPLITS.index(plan.sides[key]) for key in keys]]))[0]


def test_no_assignment_of_a_small_fleet_is_worth_more_than_the_one_found():
    rng = np.random.default_rng(3)
    shares = np.array([0.8, 0.1, 0.1])
    lossy = 0
    for _ in range(25):
        places = rng.integers(0, 3, size=9)
        met = [(v, d) for v in range(3) for d in range(3) if rng.random() < 0.7] or [(0, 0)]
        units = [Unit(f"v{v}", f"d{d}", f"p{places[3 * v + d]}", int(rng.integers(1, 9))) for v, d in met]
        keys = {key for unit in units for key in unit.keys(ALL)}
        total = sum(u.frames for u in units)
        every = np.array(list(itertools.product(range(3), repeat=len(keys))))
        best = max(worth(frames, shares, total) for frames in np.unique(kept(units, every), axis=0))
        found = kept_by(plan_split(units, ALL, 0.1, 0.1), units)
        assert worth(found, shares, total) == pytest.approx(best, abs=1e-9)
        lossy += found.sum() < total
    assert lossy > 10  # else nothing had to be cut, and dealing out groups would do


def test_three_vehicles_on_the_same_two_days_keep_half_of_their_frames_and_all_by_vehicle():
    units = [
        Unit(f"v{v}", f"d{d}", f"v{v}/d{d}: {p}", 10) for v in range(3) for d in range(2) for p in range(10)
    ]
    strict = kept_by(plan_split(units, ALL, 0.1, 0.1), units)
    # Two days fill two sides at most; two vehicles on one day and one on the other is the best that there is, and
    # without a side to choose weights by nothing can be trained.
    assert dict(zip(SPLITS, strict, strict=True)) == {"train": 200, "val": 100, "test": 0}
    by_vehicle = sides(plan_split(units, ("vehicle",), 0.1, 0.1), units)
    assert None not in by_vehicle.values()
    assert set(by_vehicle.values()) == set(SPLITS)


def test_one_vehicle_and_day_can_still_be_split_by_place():
    units = [Unit("v", "d", f"p{i}", 5) for i in range(30)]
    of = sides(plan_split(units, ("place",), 0.2, 0.2), units)
    assert {s: sum(side == s for side in of.values()) for s in SPLITS} == {"train": 18, "val": 6, "test": 6}


def test_what_was_decided_stays_when_the_fleet_grows():
    rng = np.random.default_rng(2)
    changed = 0
    for _ in range(60):
        units = random_fleet(rng)
        before = units[: len(units) // 2 + 1]
        first = plan_split(before, ALL, 0.15, 0.15)
        second = plan_split(units, ALL, 0.15, 0.15, decided=first.sides)
        for unit in before:
            side = first.side_of(unit.vehicle, unit.day, unit.place)
            assert second.side_of(unit.vehicle, unit.day, unit.place) == side
        changed += plan_split(units, ALL, 0.15, 0.15).sides != second.sides
    assert changed > 0  # else the test proves nothing


def test_the_order_of_the_units_does_not_matter_and_the_seed_does():
    units = [Unit(f"v{i}", f"d{i}", f"p{i}") for i in range(30)]
    plan = plan_split(units, ALL, 0.2, 0.2)
    assert plan_split(units[::-1], ALL, 0.2, 0.2).sides == plan.sides
    assert plan_split(units, ALL, 0.2, 0.2, seed=1).sides != plan.sides


def test_an_environment_is_what_most_moving_frames_say():
    assert environment_of_speeds([30.0] * 9 + [0.0] * 30) == "highway"
    assert environment_of_speeds([8.0] * 9 + [25.0]) == "urban"
    assert environment_of_speeds([8.0] * 5 + [-25.0] * 5) == "mixed"
    assert environment_of_speeds([None, None, 8.0]) == "unknown"
    assert environment_of_speeds([0.0]) == "unknown"

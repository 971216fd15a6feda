"""No vehicle, day or place on two sides, whatever the fleet looks like; and what was decided stays."""

import numpy as np
import pytest

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
    for _ in range(50):
        units = random_fleet(rng)
        of = sides(plan_split(units, by, 0.15, 0.15), units)
        for kind in by:
            seen = {}
            for unit, side in of.items():
                if side is not None:
                    assert seen.setdefault(getattr(unit, kind), side) == side
                    kept += 1
    assert kept > 300


def test_separate_groups_lose_no_frame_and_come_near_the_shares():
    units = [Unit(f"v{i}", f"d{i}", f"p{i}", 10) for i in range(50)]
    of = sides(plan_split(units, ALL, 0.1, 0.2), units)
    assert None not in of.values()
    share = {s: np.mean([side == s for side in of.values()]) for s in SPLITS}
    assert share == pytest.approx({"train": 0.7, "val": 0.1, "test": 0.2}, abs=0.021)


def test_a_fleet_that_hangs_together_is_one_group_and_vehicles_alone_divide_it():
    units = [
        Unit(f"v{v}", f"d{d}", f"v{v}/d{d}: {p}") for v in range(12) for d in range(10) for p in range(3)
    ]
    assert len(set(sides(plan_split(units, ALL, 0.1, 0.1), units).values())) == 1
    for by in (("vehicle", "place"), ("vehicle",)):
        of = sides(plan_split(units, by, 0.1, 0.1), units)
        assert None not in of.values()
        assert set(of.values()) == set(SPLITS)


def test_what_was_decided_stays_when_the_fleet_grows():
    rng = np.random.default_rng(2)
    changed = 0
    for k in range(30):
        units, by = random_fleet(rng), (ALL, ("vehicle",))[k % 2]
        before = units[: len(units) // 2 + 1]
        first = plan_split(before, by, 0.15, 0.15)
        second = plan_split(units, by, 0.15, 0.15, decided=first.sides)
        for unit in before:
            side = first.side_of(unit.vehicle, unit.day, unit.place)
            assert second.side_of(unit.vehicle, unit.day, unit.place) == side
        changed += plan_split(units, by, 0.15, 0.15).sides != second.sides
    assert changed > 0  # else the test proves nothing


def test_a_frame_whose_keys_were_decided_differently_is_left_out_and_the_others_stay():
    apart = [Unit(f"v{i}", f"d{i}", f"p{i}") for i in range(6)]
    first = plan_split(apart, ALL, 0.2, 0.2)
    of = sides(first, apart)
    one, other = (next(u for u in apart if of[u] == side) for side in ("train", "test"))
    between = Unit(one.vehicle, other.day, "new")
    second = sides(plan_split([*apart, between], ALL, 0.2, 0.2, decided=first.sides), [*apart, between])
    assert second == {**of, between: None}


def test_an_environment_is_what_most_moving_frames_say():
    assert environment_of_speeds([30.0] * 9 + [0.0] * 30) == "highway"
    assert environment_of_speeds([8.0] * 9 + [25.0]) == "urban"
    assert environment_of_speeds([8.0] * 5 + [-25.0] * 5) == "mixed"
    assert environment_of_speeds([None, None, 8.0]) == "unknown"
    assert environment_of_speeds([0.0]) == "unknown"

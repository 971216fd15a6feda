"""Which frames train, validate and test a network: no vehicle, day or place on two sides.

Frames are linked by what they share. Where the links leave separate groups, whole groups are dealt out and no frame is
lost. Where everything hangs together (every vehicle drives every day), vehicles and days are divided each for itself,
every place goes to the side that has most of it, and a frame counts only where all of its keys agree.

What an earlier run decided stays decided: a lake grows, and a frame that tested one network must not train the next.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from schemas.training import SPLITS

__all__ = ["SplitPlan", "Unit", "environment_of_speeds", "plan_split"]

TRAIN, VAL, TEST = SPLITS
# As calibration_records: 72 km/h is beyond what towns allow.
_FAST_MPS, _MOVING_MPS = 20.0, 1.0


@dataclass(frozen=True)
class Unit:
    """Frames that share vehicle, day and place."""

    vehicle: str
    day: str
    place: str
    frames: int = 1

    def keys(self, by: Iterable[str]) -> list[tuple[str, str]]:
        """What links it with other units."""
        return [(kind, getattr(self, kind)) for kind in by]


@dataclass(frozen=True)
class SplitPlan:
    """The side of every vehicle, day and place that frames are split by."""

    by: tuple[str, ...]
    sides: Mapping[tuple[str, str], str] = field(default_factory=dict)

    def side_of(self, vehicle: str, day: str, place: str) -> str | None:
        """train, val or test; None where the keys do not agree."""
        sides = {self.sides.get(key) for key in Unit(vehicle, day, place).keys(self.by)}
        return sides.pop() if len(sides) == 1 else None


def plan_split(
    units: Sequence[Unit],
    by: Sequence[str],
    val_fraction: float,
    test_fraction: float,
    seed: int = 0,
    decided: Mapping[tuple[str, str], str] | None = None,
) -> SplitPlan:
    """Divide units; the same input gives the same plan.

    Args:
        units: what there is.
        by: kinds of keys that no two sides may share: vehicle, day, place.
        val_fraction: share of the frames that choose the best weights.
        test_fraction: share of the frames that test a finished network.
        seed: of the draw.
        decided: sides of keys that earlier runs gave.
    """
    shares = {TRAIN: 1 - val_fraction - test_fraction, VAL: val_fraction, TEST: test_fraction}
    shares = {side: share for side, share in shares.items() if share > 0}
    known = {key: side for key, side in (decided or {}).items() if key[0] in by}
    groups = _linked(units, by)
    if len(groups) >= len(shares) and all(len(_decided(g, by, known)) <= 1 for g in groups):
        return SplitPlan(tuple(by), known | _deal_groups(groups, by, shares, seed, known))
    return SplitPlan(tuple(by), known | _divide_keys(units, by, shares, seed, known))


def environment_of_speeds(speeds_mps: Sequence[float | None]) -> str:
    """Highway, urban, mixed or unknown from the speeds of a drive, as calibration records say it of a day."""
    known = [abs(s) for s in speeds_mps if s is not None]
    moving = [s for s in known if s > _MOVING_MPS]
    if 2 * len(known) < len(speeds_mps) or not moving:
        return "unknown"
    fast = sum(s >= _FAST_MPS for s in moving) / len(moving)
    return "highway" if fast > 0.7 else "urban" if fast < 0.3 else "mixed"


def _linked(units: Sequence[Unit], by: Sequence[str]) -> list[list[Unit]]:
    """Groups of units that share keys, directly or through others."""
    parent: dict[tuple[str, str], tuple[str, str]] = {}

    def root(key: tuple[str, str]) -> tuple[str, str]:
        parent.setdefault(key, key)
        while parent[key] != key:
            parent[key] = parent[parent[key]]
            key = parent[key]
        return key

    for unit in units:
        first, *others = unit.keys(by)
        for other in others:
            parent[root(other)] = root(first)
    groups: dict[tuple[str, str], list[Unit]] = defaultdict(list)
    for unit in units:
        groups[root(unit.keys(by)[0])].append(unit)
    return list(groups.values())


def _deal_groups(
    groups: Sequence[list[Unit]],
    by: Sequence[str],
    shares: Mapping[str, float],
    seed: int,
    known: Mapping[tuple[str, str], str],
) -> dict[tuple[str, str], str]:
    """Whole groups, the largest first, to the side that lacks most; every side gets one at least."""
    total = sum(u.frames for g in groups for u in g)
    have: Counter[str] = Counter()
    sides: dict[tuple[str, str], str] = {}
    free = []
    for group in groups:
        earlier = _decided(group, by, known)
        if earlier:
            _assign(group, by, earlier.pop(), sides, have)
        else:
            free.append(group)
    free.sort(key=lambda g: (-sum(u.frames for u in g), _rank(min(u.keys(by)[0] for u in g), seed)))
    for position, group in enumerate(free):
        empty = [side for side in shares if not have[side]]
        open_to = empty if len(empty) >= len(free) - position else list(shares)
        lacks = {side: shares[side] * total - have[side] for side in open_to}
        _assign(group, by, max(open_to, key=lambda s: lacks[s]), sides, have)
    return sides


def _decided(group: Sequence[Unit], by: Sequence[str], known: Mapping[tuple[str, str], str]) -> set[str]:
    return {known[key] for unit in group for key in unit.keys(by) if key in known}


def _assign(
    group: Sequence[Unit],
    by: Sequence[str],
    side: str,
    sides: dict[tuple[str, str], str],
    have: Counter[str],
) -> None:
    for unit in group:
        have[side] += unit.frames
        for key in unit.keys(by):
            sides[key] = side


def _divide_keys(
    units: Sequence[Unit],
    by: Sequence[str],
    shares: Mapping[str, float],
    seed: int,
    known: Mapping[tuple[str, str], str],
) -> dict[tuple[str, str], str]:
    """Vehicles and days each for itself, then places by majority; places by quota where they stand alone."""
    drawn = [kind for kind in by if kind != "place"] or ["place"]
    values = {kind: sorted({getattr(u, kind) for u in units}) for kind in drawn}
    divisible = [kind for kind in drawn if len(values[kind]) > 1]
    sides: dict[tuple[str, str], str] = {}
    for kind in drawn:
        quota = _share_per_kind(shares, max(1, len(divisible)))
        sides |= _draw(kind, values[kind], quota if kind in divisible else {TRAIN: 1.0}, seed, known)
    if "place" in by and "place" not in drawn:
        sides |= _majorities(units, drawn, sides | dict(known), known)
    return sides


def _share_per_kind(shares: Mapping[str, float], kinds: int) -> dict[str, float]:
    """Shares of each of several independent draws, so that what all of them agree on has the wanted shares."""
    roots = {side: share ** (1 / kinds) for side, share in shares.items()}
    return {side: r / sum(roots.values()) for side, r in roots.items()}


def _draw(
    kind: str,
    values: Sequence[str],
    shares: Mapping[str, float],
    seed: int,
    known: Mapping[tuple[str, str], str],
) -> dict[tuple[str, str], str]:
    """Deal values in an order that only their names and the seed decide."""
    have = Counter(known[kind, v] for v in values if (kind, v) in known)
    free = sorted((v for v in values if (kind, v) not in known), key=lambda v: _rank((kind, v), seed))
    sides = {}
    for position, value in enumerate(free):
        empty = [side for side in shares if not have[side]]
        open_to = empty if len(empty) >= len(free) - position else list(shares)
        side = max(open_to, key=lambda s: shares[s] * len(values) - have[s])
        sides[kind, value] = side
        have[side] += 1
    return sides


def _majorities(
    units: Sequence[Unit],
    by: Sequence[str],
    sides: Mapping[tuple[str, str], str],
    known: Mapping[tuple[str, str], str],
) -> dict[tuple[str, str], str]:
    """Each place to the side that would lose most without it, as a share of what that side has."""
    frames: dict[str, Counter[str]] = defaultdict(Counter)
    for unit in units:
        side = SplitPlan(tuple(by), sides).side_of(unit.vehicle, unit.day, unit.place)
        if side is not None:
            frames[unit.place][side] += unit.frames
    total: Counter[str] = sum(frames.values(), Counter())
    return {
        ("place", place): max(SPLITS, key=lambda s: count[s] / total[s] if total[s] else 0.0)
        for place, count in frames.items()
        if ("place", place) not in known
    }


def _rank(key: tuple[str, str], seed: int) -> str:
    return hashlib.sha256(f"{seed}/{key[0]}/{key[1]}".encode()).hexdigest()

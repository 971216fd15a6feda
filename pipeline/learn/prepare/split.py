"""Split of frames for training, validation and test of a network: no vehicle, day or place is on two sides.

Frames with a common key are linked, directly or through others. Whole groups of linked frames are assigned, the largest
first, equal ones in the order of a hash, to the side that lacks most. Where all frames are linked (every vehicle drives
every day, and days are among the keys), only one side has frames: split by fewer keys (`sides.settled_keys`).

Decisions of earlier runs are kept: a lake grows, and a frame that tested one network must not train the next. A frame
whose keys were decided differently is left out.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from schemas.training import SPLITS

__all__ = ["SplitPlan", "Unit", "environment_of_speeds", "plan_split"]

# As calibration_records: 72 km/h is above the limit in towns.
_FAST_MPS, _MOVING_MPS = 20.0, 1.0


@dataclass(frozen=True)
class Unit:
    """Frames that share vehicle, day and place."""

    vehicle: str
    day: str
    place: str
    frames: int = 1

    def keys(self, by: Iterable[str]) -> list[tuple[str, str]]:
        """Keys that link it with other units."""
        return [(kind, getattr(self, kind)) for kind in by]


@dataclass(frozen=True)
class SplitPlan:
    """The side of every vehicle, day and place used for the split."""

    by: tuple[str, ...]
    sides: Mapping[tuple[str, str], str] = field(default_factory=dict)

    def side_of(self, vehicle: str, day: str, place: str) -> str | None:
        """train, val or test; None if the keys do not agree."""
        sides = {self.sides.get(key) for key in Unit(vehicle, day, place).keys(self.by)}
        return sides.pop() if len(sides) == 1 else None


def plan_split(
    units: Sequence[Unit], by: Sequence[str], val_fraction: float, test_fraction: float, seed: int = 0,
    decided: Mapping[tuple[str, str], str] | None = None,
) -> SplitPlan:  # fmt: skip
    """Divide units; the same input gives the same plan.

    Args:
        by: kinds of keys that no two sides may share: vehicle, day, place.
        val_fraction: share of the frames that choose the best weights.
        test_fraction: share of the frames that test a finished network.
        decided: sides of keys that earlier runs gave.
    """
    fractions = (1 - val_fraction - test_fraction, val_fraction, test_fraction)
    shares = {side: share for side, share in zip(SPLITS, fractions, strict=True) if share > 0}
    units = sorted(units, key=lambda u: (u.vehicle, u.day, u.place))
    known = {key: side for key, side in (decided or {}).items() if key[0] in by and side in shares}
    return SplitPlan(tuple(by), _deal_groups(_linked(units, by), by, shares, seed, known) | known)


def environment_of_speeds(speeds_mps: Sequence[float | None]) -> str:
    """Highway, urban, mixed or unknown by the speeds of a drive, as in calibration records."""
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
    groups: Sequence[list[Unit]], by: Sequence[str], shares: Mapping[str, float], seed: int,
    known: Mapping[tuple[str, str], str],
) -> dict[tuple[str, str], str]:  # fmt: skip
    """Assign whole groups, the largest first, to the side that lacks most; every side gets at least one."""
    total = sum(u.frames for g in groups for u in g)
    have: Counter[str] = Counter()
    sides: dict[tuple[str, str], str] = {}

    def assign(group: Sequence[Unit], side: str) -> None:
        have[side] += sum(unit.frames for unit in group)
        sides.update(dict.fromkeys((key for unit in group for key in unit.keys(by)), side))

    def rank(group: Sequence[Unit]) -> tuple[int, str]:
        kind, value = min(unit.keys(by)[0] for unit in group)
        digest = hashlib.sha256(f"{seed}/{kind}/{value}".encode()).hexdigest()
        return -sum(unit.frames for unit in group), digest

    free = []
    for group in groups:
        earlier = Counter(known[key] for unit in group for key in unit.keys(by) if key in known)
        if earlier:
            assign(group, max(SPLITS, key=lambda side: earlier[side]))
        else:
            free.append(group)
    for position, group in enumerate(sorted(free, key=rank)):
        empty = [side for side in shares if not have[side]]
        open_to = empty if len(empty) >= len(free) - position else list(shares)
        lacks = {side: shares[side] * total - have[side] for side in open_to}
        assign(group, max(open_to, key=lambda s: lacks[s]))
    return sides

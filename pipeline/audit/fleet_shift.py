"""Changes that nearly all vehicles of a model show on the same day: a release, or another common cause.

They are removed from the days of the model's vehicles, which are judged again, so a vehicle that was also
knocked on that day still shows a change. A change of half of a model's vehicles is not removed, because no majority
determines which half is right.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.audit.days import PairDays
from pipeline.audit.vehicle import VehicleVerdict, judge_fleet
from pipeline.core.config import AuditConfig
from pipeline.rig.graph import Edge
from schemas.calibrations import DOF_NAMES

__all__ = ["FleetShift", "judge_without_fleet_shifts"]

# Fewer vehicles are no fleet: three knocked on one day may have met the same kerb.
_FEWEST_VEHICLES = 6
_ALARMS = 0.3  # share of the vehicles with days on both sides whose charts show the change
_SHARE = 0.8  # of them that lie nearer to the common change than to none
_DAYS_APART = 1  # of the days on which they show it: not all drive daily


@dataclass(frozen=True)
class FleetShift:
    """One chart of most vehicles changed on one day: first ordinal with the new value, median size [rad or m]."""

    day: int
    size: float
    vehicles: int
    of: int


def judge_without_fleet_shifts(
    fleet: Sequence[Mapping[Edge, PairDays]], config: AuditConfig, models: Sequence[str]
) -> tuple[list[VehicleVerdict], dict[str, dict[tuple[Edge, str], FleetShift]]]:
    """Verdicts on all vehicles, and the removed changes of each model by edge and DoF; `models` by vehicle."""
    verdicts = judge_fleet(fleet, config, models)
    shifts: dict[str, dict[tuple[Edge, str], FleetShift]] = {}
    for model in sorted(set(models)):
        rows = [v for v, name in enumerate(models) if name == model]
        shifts[model] = _shifts([fleet[v] for v in rows], [verdicts[v] for v in rows])
    if any(shifts.values()):
        without = [_without(pairs, shifts[name]) for name, pairs in zip(models, fleet, strict=True)]
        verdicts = judge_fleet(without, config, models)
    return verdicts, shifts


def _shifts(
    fleet: Sequence[Mapping[Edge, PairDays]], verdicts: Sequence[VehicleVerdict]
) -> dict[tuple[Edge, str], FleetShift]:
    found = {}
    for key in {k: None for v in verdicts for k, chart in v.charts.items() if chart.change is not None}:
        changes = [v.charts[key].change for v in verdicts if key in v.charts]
        starts = Counter((c.day, c.size > 0) for c in changes if c is not None and c.kind == "step")
        if not starts:
            continue
        day, up = max(starts, key=lambda start: (starts[start], start))
        vehicles = sum(n for (d, u), n in starts.items() if u == up and abs(d - day) <= _DAYS_APART)
        sizes = np.array([s for pairs in fleet if (s := _size(pairs, key, day)) is not None])
        if vehicles < max(_FEWEST_VEHICLES, _ALARMS * len(sizes)):
            continue
        size = float(np.median(sizes))
        alike = int((np.abs(sizes - size) < np.abs(sizes)).sum())
        if alike >= _SHARE * len(sizes):
            found[key] = FleetShift(day, size, alike, len(sizes))
    return found


def _size(pairs: Mapping[Edge, PairDays], key: tuple[Edge, str], day: int) -> float | None:
    """Median after minus median before, of one vehicle; None with fewer than two days on a side."""
    days = pairs.get(key[0])
    if days is None:
        return None
    k = DOF_NAMES.index(key[1])
    seen = days.observable[:, k]
    value, is_after = days.change[seen, k], days.day[seen] >= day
    enough = is_after.sum() > 1 and ((~is_after).sum() > 1 or days.reference_days > 0)
    if not enough or is_after.all():
        return None
    return float(np.median(value[is_after]) - np.median(value[~is_after]))


def _without(
    own: Mapping[Edge, PairDays], shifts: Mapping[tuple[Edge, str], FleetShift]
) -> dict[Edge, PairDays]:
    out = {}
    for edge, days in own.items():
        change = days.change.copy()
        for k, dof in enumerate(DOF_NAMES):
            shift = shifts.get((edge, dof))
            if shift is not None:
                change[days.day >= shift.day, k] -= shift.size
        out[edge] = replace(days, change=change)
    return out

"""Whether the audit of a rig of many sensors keeps its false-alarm budget, and names the sensor that moved.

Rigs have eight sensors and sixteen edges (`tests/makers/random_rigs.py`), 96 charts a vehicle. Each day's edges err by
themselves and, in part, by what their sensors share: `shared` times .03 deg and 2 cm per axis of each sensor and day,
in all edges of that sensor alike. Every night the audit's functions judge the window of that night.

    python -m tests.benchmarks.studies.rig_drift [--vehicles 100] [--days 60] [--seed 9200] [--shared 1] [--knock]
        [--records LAKE]

With --records the rig is that of a lake's day: its edges err as their records say and hold as theirs do.
Prints a line of JSON: false alarms per 1,000 vehicle-nights, or with --knock (half a degree of a sensor with three
edges or more, from half of the days on) how often it is named three nights later, and with the right day.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.audit.days import PairDays, pair_days
from pipeline.audit.vehicle import VehicleVerdict, judge_fleet
from pipeline.config import AuditConfig
from pipeline.geometry.se3 import adjoint, exp_se3, inverse
from pipeline.rig.edges import edge_named
from pipeline.rig.graph import Edge
from pipeline.store.current import current_poses, current_records, transform_of
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.poses import POSES, PoseRow
from tests.benchmarks.studies.commits import commit_now
from tests.makers.random_rigs import SHIFT_SIGMAS, UNSURE_DEG, UNSURE_M, Rig, knock

_OWN = np.r_[np.full(3, np.radians(0.03)), np.full(3, 0.02)]  # of a sensor's daily error, times `shared`
_FIRST_NIGHT, _NIGHTS_LATER = 6, 3


@dataclass(frozen=True, eq=False)
class Vehicle:
    """All days of one vehicle by edge, and the sensor that is knocked; empty = none."""

    days: Mapping[Edge, PairDays]
    knocked: str = ""


@dataclass(frozen=True, eq=False)
class Own:
    """How an edge errs by itself (6 6), which of its degrees of freedom a day shows, and whether it is accepted."""

    covariance: np.ndarray
    seen: np.ndarray
    accepted: bool = True

    @classmethod
    def of_kind(cls, kind: str) -> Own:
        """Of an edge of a random rig."""
        rotation, shift = (np.array(part) for part in SHIFT_SIGMAS[kind])
        return cls(
            np.diag(np.r_[np.radians(rotation), shift] ** 2), np.r_[rotation < UNSURE_DEG, shift < UNSURE_M]
        )


class RecordedRig:
    """The rig of the first day of a lake: its edges with an estimate, as their records say."""

    def __init__(self, lake: Lake) -> None:
        records = current_records(read_records(lake, CALIBRATIONS, CalibrationRecord))
        poses = current_poses(read_records(lake, POSES, PoseRow))
        self.T = {p.sensor: T for p in poses if p.day == poses[0].day and (T := transform_of(p)) is not None}
        self.own = dict[Edge, Own]()
        for r in records:
            if (
                r.day != poses[0].day
                or r.covariance is None
                or not {r.parent_frame, r.child_frame} <= set(self.T)
            ):
                continue
            common = 0.0 if r.common_covariance is None else r.common_covariance
            edge = edge_named(r.pair, r.parent_frame, r.child_frame)
            self.own[edge] = Own(r.covariance - common, np.array(r.observable), r.status == "accepted")
        self.edges = list(self.own)
        self.sensors = sorted({s for edge in self.edges for s in edge.sensors}, key=lambda s: s.name)

    def degree(self, name: str) -> int:
        """Number of edges of a sensor."""
        return sum(name in (s.name for s in edge.sensors) for edge in self.edges)


def vehicle(
    rng: np.random.Generator, days: int, shared: float, *, knocked: bool, recorded: RecordedRig | None = None
) -> Vehicle:
    """Days of a random rig, or of a recorded one; the knock comes after half of them."""
    rig, name = recorded or Rig(rng), ""
    error = {s.name: rng.normal(size=(days, 6)) * _OWN * shared for s in rig.sensors}
    if knocked:
        able = [s for s in rig.sensors if rig.degree(s.name) >= 3]
        sensor = able[int(rng.integers(len(able)))]
        name = sensor.name
        error[name][days // 2 :] += knock(rng, sensor)
    return Vehicle({edge: _edge_days(rng, rig, edge, error, shared) for edge in rig.edges}, name)


def _edge_days(
    rng: np.random.Generator,
    rig: Rig | RecordedRig,
    edge: Edge,
    error: Mapping[str, np.ndarray],
    shared: float,
) -> PairDays:
    T = inverse(rig.T[edge.parent.name]) @ rig.T[edge.child.name]
    of_edge = rig.own[edge] if isinstance(rig, RecordedRig) else Own.of_kind(edge.kind)
    own, A = of_edge.covariance, adjoint(T)
    D = len(error[edge.parent.name])
    xi = rng.multivariate_normal(np.zeros(6), own, size=D)
    xi += error[edge.child.name] @ A.T - error[edge.parent.name]
    sensor = np.diag((_OWN * shared) ** 2)
    covariance = np.tile(own + sensor + A @ sensor @ A.T, (D, 1, 1))
    seen, every = np.tile(of_edge.seen, (D, 1)), np.full(D, of_edge.accepted)
    return pair_days(np.arange(D) + 1, exp_se3(xi) @ T, covariance, np.zeros((D, 6, 6)), seen, every)


def tonight(fleet: Sequence[Vehicle], night: int, config: AuditConfig) -> list[VehicleVerdict]:
    """What the audit says of all vehicles on a night."""
    first = max(1, night - config.window_days + 1)
    return judge_fleet([{e: d.between(first, night) for e, d in v.days.items()} for v in fleet], config)


def false_alarms(fleet: Sequence[Vehicle], days: int) -> dict[str, float]:
    """Nights with a RED chart, and with any alarm, per 1,000 vehicle-nights."""
    found, config = Counter[str](), AuditConfig()
    for night in range(_FIRST_NIGHT, days + 1):
        for verdict in tonight(fleet, night, config):
            statuses = {chart.status for chart in verdict.charts.values()}
            found.update(nights=1, red="RED" in statuses, any=bool(statuses & {"RED", "YELLOW"}))
    return {"nights": found["nights"], **{k: 1000 * found[k] / found["nights"] for k in ("red", "any")}}


def named(fleet: Sequence[Vehicle], days: int) -> dict[str, float]:
    """Of vehicles with a knock, shares a few nights later: RED, the sensor named, another one named, the day right."""
    start, found = days // 2 + 1, Counter[str]()
    for own, verdict in zip(fleet, tonight(fleet, start + _NIGHTS_LATER - 1, AuditConfig()), strict=True):
        sensor = None if verdict.attribution is None else verdict.attribution.sensor
        red = [c.change.day for c in verdict.charts.values() if c.status == "RED" and c.change]
        found.update(
            red=bool(red), right=sensor == own.knocked, wrong=sensor not in (own.knocked, None),
            dated=bool(red) and max(Counter(red).items(), key=lambda kv: kv[1])[0] == start,
        )  # fmt: skip
    return {"vehicles": len(fleet), **{k: found[k] / len(fleet) for k in ("red", "right", "wrong", "dated")}}


def main() -> None:
    """Run one case and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicles", type=int, default=100)
    parser.add_argument("--days", type=int, default=60)
    parser.add_argument("--seed", type=int, default=9200)
    parser.add_argument("--shared", type=float, default=1.0)
    parser.add_argument("--knock", action="store_true")
    parser.add_argument("--records", type=Path)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    recorded = None if args.records is None else RecordedRig(Lake.at(args.records))
    fleet = [
        vehicle(rng, args.days, args.shared, knocked=args.knock, recorded=recorded)
        for _ in range(args.vehicles)
    ]
    found = named(fleet, args.days) if args.knock else false_alarms(fleet, args.days)
    rig = "random" if recorded is None else args.records.name
    print(json.dumps({"commit": commit_now()} | vars(args) | {"records": rig} | found))


if __name__ == "__main__":
    main()

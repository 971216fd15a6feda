"""How often the charts of `boresight audit` call a false alarm, and how soon they find what moved, night by night.

Vehicles are day estimates made by SE(3) algebra, with errors of known kind; every night the audit's own functions judge
the window of that night beside the fixed reference, as `boresight audit` does. False alarms are counted over all
nights, detections after a step.

    python -m tests.benchmarks.studies.drift_charts [--vehicles 1000] [--nights 100] [--days real] [--fleet 50]
        [--first-seed 64000] [--tune SEED]

A line per kind of errors and case is added to results/drift_charts.jsonl; what stands there already is not run again.
Days are as sure as `--days` says: `tests` as in tests/audit, `real` as accepted camera-lidar records of real cars.
Errors of several kinds are joined by ` + `. Seeds 0 to 199 are for tuning (`--tune` runs those and writes nothing).
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.audit.days import PairDays, Reference, charted, pair_days, reference_of
from pipeline.audit.status import decide_status
from pipeline.audit.vehicle import VehicleVerdict, judge_fleet, limit_of
from pipeline.config import AuditConfig
from pipeline.geometry.se3 import adjoint, exp_se3, from_rotation_translation, inverse
from pipeline.rig.edges import EDGE_OF_PAIR
from pipeline.rig.graph import Edge
from schemas.calibrations import PAIRS
from schemas.drift import DriftFinding, VehicleStatus
from tests.benchmarks.studies.commits import commit_now

RESULTS = Path("tests/benchmarks/results/drift_charts.jsonl")
NOISES = (
    "white", "ar .3", "ar .6", "t4", "wrong sigmas", "floors", "warmth .03", "warmth .06", "ar .6 + sigmas x.5",
    "ar .6 + sigmas x2", "ar .6 + t4", "ar .6 + warmth .06", "ar .6 + t4 + wrong sigmas + warmth .06",
)  # fmt: skip
T_CAMERA_LIDAR = from_rotation_translation(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.05, -0.4, -0.6])
)
T_LIDAR_RADAR = from_rotation_translation(np.eye(3), np.array([2.1, 0.1, -1.3]))
# What days vary by (rx ry rz [deg], tx ty tz [m]), as in tests/audit: radar roll and height beyond the size that
# matters, where the charts live by their statistics alone. And what all days have in common.
_RADAR = (0.5, 0.12, 0.05, 0.02, 0.02, 0.2)
VARYING = {
    "tests": {"camera_lidar": (0.02, 0.02, 0.02, 0.015, 0.015, 0.02), "lidar_radar": _RADAR},
    "real": {"camera_lidar": (0.04, 0.06, 0.06, 0.015, 0.015, 0.02), "lidar_radar": _RADAR},
}
COMMON = {
    "camera_lidar": (0.03, 0.03, 0.05, 0.01, 0.006, 0.05),
    "lidar_radar": (0.2, 0.2, 0.01, 0.025, 0.013, 0.02),
}
LOG_SD = 0.25  # of what a vehicle's sigmas are wrong by
YEAR = 365.25
WEATHER = (
    0.8,
    0.5,
)  # autocorrelation of days' temperatures, and their scatter in amplitudes of the year's swing


@dataclass(frozen=True)
class Case:
    """What happens to every vehicle of a run.

    Args:
        name: of the case.
        sensor: that moves; empty where none does.
        twist: in its own axes [rad, m].
        slow: the twist is what it turns by each day, not once.
        on: first day with the new pose.
        back: first day on which it is repaired; 0 = never.
        served: day of a service event: charts begin anew after it, with the sensor where it is; 0 = none.
        held: share of days that are held, refused and disproved (a lost basin), from two days before on.
    """

    name: str
    sensor: str = ""
    twist: tuple[float, ...] = (0.0,) * 6
    on: int = 0
    back: int = 0
    served: int = 0
    lost: float = 0.0
    days: int = 100
    slow: bool = False


def _turn(axis: str, deg: float) -> tuple[float, ...]:
    return tuple(float(np.radians(deg)) if a == axis else 0.0 for a in ("x", "y", "z")) + (0.0, 0.0, 0.0)


CASES = (
    Case("nothing"),
    Case("camera yaw .3", "camera", _turn("y", 0.3), on=40, days=70),
    Case("camera pitch .3", "camera", _turn("x", 0.3), on=40, days=70),
    Case("radar yaw .5", "radar", _turn("z", 0.5), on=40, days=70),
    Case("radar pitch .5", "radar", _turn("y", 0.5), on=40, days=70),
    Case("lidar yaw .3", "lidar", _turn("z", 0.3), on=40, days=70),
    Case("radar knock 1, days lost", "radar", _turn("z", 1.0), on=40, lost=0.3, days=70),
    Case("camera knock 1, days lost", "camera", _turn("y", 1.0), on=40, lost=0.3, days=70),
    Case("camera .3 on day 5", "camera", _turn("y", 0.3), on=4, days=80),
    Case("camera .3, back", "camera", _turn("y", 0.3), on=40, back=50, days=70),
    Case("camera .3, service event", "camera", _turn("y", 0.3), on=40, served=49, days=70),
    Case("camera roll .3", "camera", _turn("z", 0.3), on=40, days=70),
    Case("camera pitch .05 a day", "camera", _turn("x", 0.05), on=40, days=60, slow=True),
    Case("camera yaw .05 a day", "camera", _turn("y", 0.05), on=40, days=60, slow=True),
    Case("camera roll .05 a day", "camera", _turn("z", 0.05), on=40, days=60, slow=True),
    Case("camera roll .05 a day, five days of two vehicles", "camera", _turn("z", 0.05), days=7, slow=True),
)


@dataclass(frozen=True, eq=False)
class Vehicle:
    """All days of one vehicle, and the references that froze."""

    pairs: Mapping[str, PairDays]
    served: int = 0
    frozen: dict[str, Reference] = field(default_factory=dict)

    def tonight(self, night: int, config: AuditConfig) -> dict[Edge, PairDays]:
        """What the audit looks at on a night."""
        first = night - config.window_days + 1
        return {EDGE_OF_PAIR[pair]: self._charted(pair, first, night, config) for pair in self.pairs}

    def _charted(self, pair: str, first: int, night: int, config: AuditConfig) -> PairDays:
        days = self.pairs[pair]
        if self.served and night > self.served and "camera" in pair:
            since = days.between(self.served + 1, night)
            return charted(since, first, night, reference_of(since, config.reference_days))
        reference = self.frozen.get(pair)
        if reference is None and first > 0:
            known = days.between(0, night)
            reference = reference_of(known, config.reference_days)
            if reference is not None and known.accepted.sum() >= config.reference_days:
                self.frozen[pair] = reference
        return charted(days, first, night, reference)


def make_vehicle(noise: str, case: Case, rng: np.random.Generator, sure: str = "tests") -> Vehicle:
    """A vehicle's days: errors of a kind, and what happens to it."""
    D = case.days
    moved = np.zeros((D, 6))
    moved[case.on : case.back or D] = case.twist
    if case.slow:
        moved = np.cumsum(moved, axis=0) - moved * (case.on == 0)
    warmth = _swing(noise, D, rng)
    M = {s: exp_se3(moved if s == case.sensor else np.zeros((D, 6))) for s in ("camera", "lidar", "radar")}
    M["camera"] = M["camera"] @ exp_se3(warmth)
    clean = {
        "camera_lidar": inverse(M["camera"]) @ T_CAMERA_LIDAR @ M["lidar"],
        "lidar_radar": inverse(M["lidar"]) @ T_LIDAR_RADAR @ M["radar"],
    }
    T, varying, common = {}, {}, {}
    wrong = float(np.exp(rng.normal(0, LOG_SD))) if "wrong sigmas" in noise else 1.0
    wrong /= next((float(part.split(" x")[1]) for part in noise.split(" + ") if "sigmas x" in part), 1.0)
    for pair, T_clean in clean.items():
        sigma, floor = _si(VARYING[sure][pair]), _si(COMMON[pair])
        # Roll and height are found together.
        correlation = np.eye(6)
        correlation[1, 5] = correlation[5, 1] = 0.5
        varying[pair] = correlation * np.outer(sigma, sigma)
        common[pair] = np.diag(floor**2) if "floors" in noise else np.zeros((6, 6))
        error = wrong * _errors(noise, D, rng) @ np.linalg.cholesky(varying[pair]).T
        error = error + rng.normal(size=6) @ np.sqrt(common[pair])
        T[pair] = exp_se3(error) @ T_clean
    T["camera_radar"] = T["camera_lidar"] @ T["lidar_radar"]
    A = adjoint(T_CAMERA_LIDAR)
    for part in (varying, common):
        part["camera_radar"] = part["camera_lidar"] + A @ part["lidar_radar"] @ A.T
    kept, accepted = _fates(case, rng)
    return Vehicle(
        {
            pair: pair_days(
                np.arange(D)[kept],
                T[pair][kept],
                _held(varying[pair] + common[pair], common[pair], accepted[kept]),
                np.broadcast_to(common[pair], (int(kept.sum()), 6, 6)),
                np.ones((int(kept.sum()), 6), bool),
                accepted[kept],
            )
            for pair in PAIRS
        },
        case.served,
    )


def _si(sigma: tuple[float, ...]) -> np.ndarray:
    return np.array([*np.radians(sigma[:3]), *sigma[3:]])


def _errors(noise: str, days: int, rng: np.random.Generator) -> np.ndarray:
    """Errors (days, 6) of variance 1."""
    parts = noise.split(" + ")
    e = rng.standard_t(4, size=(days, 6)) / np.sqrt(2) if "t4" in parts else rng.normal(size=(days, 6))
    phi = next((float(part.split()[1]) for part in parts if part.startswith("ar")), 0.0)
    for k in range(1, days):
        e[k] = phi * e[k - 1] + np.sqrt(1 - phi**2) * e[k]
    return e


def _swing(noise: str, days: int, rng: np.random.Generator) -> np.ndarray:
    """The camera's turn in its bracket with the temperature: pitch and yaw, over the year and with the weather."""
    turn = np.zeros((days, 6))
    if "warmth" in noise:
        amplitude, (phi, scatter) = float(np.radians(float(noise.rsplit(maxsplit=1)[-1]))), WEATHER
        year = np.sin(2 * np.pi * (np.arange(days) / YEAR + rng.uniform()))
        weather = rng.normal(size=days)
        for k in range(1, days):
            weather[k] = phi * weather[k - 1] + np.sqrt(1 - phi**2) * weather[k]
        direction = rng.uniform(0, 2 * np.pi)
        turn[:, :2] = amplitude * (year + scatter * weather)[:, None] * [np.cos(direction), np.sin(direction)]
    return turn


def _fates(case: Case, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Days that enter a chart, and which of them were accepted: a third of the lost days is held, the rest is none."""
    draw = np.where(np.arange(case.days) >= case.on - 2, rng.uniform(size=case.days), 1.0)
    return draw >= case.lost * 2 / 3, draw >= case.lost


def _held(covariance: np.ndarray, common: np.ndarray, accepted: np.ndarray) -> np.ndarray:
    factor = np.where(accepted, 1.0, AuditConfig().held_sigma_factor ** 2)
    return common + factor[:, None, None] * (covariance - common)


def status_of_night(verdict: VehicleVerdict, config: AuditConfig) -> VehicleStatus:
    """The vehicle's status as the audit decides it from its rows."""
    rows = []
    for (edge, dof), chart in verdict.charts.items():
        change, moved = chart.change, verdict.attribution
        rows.append(
            DriftFinding(
                vehicle="v", day="", method="joint", pair=edge.kind, parent_frame=edge.parent.name,
                child_frame=edge.child.name, dof=dof, status=chart.status,
                reason=chart.reason, days_used=chart.days_used, limit=limit_of(edge, dof, config),
                statistic=chart.statistic, threshold=chart.threshold,
                start_day=None if change is None else str(change.day),
                kind=None if change is None else change.kind,
                moved_sensor=None if change is None or moved is None else moved.sensor,
            )
        )  # fmt: skip
    return decide_status(rows)


def nights(
    fleet: list[Vehicle], which: Iterable[int], config: AuditConfig, size: int = 0
) -> Iterator[tuple[int, list[VehicleVerdict]]]:
    """Verdicts of every night; `size` vehicles are judged as one fleet, all of them where it is 0."""
    size = size or len(fleet)
    for night in which:
        parts = [fleet[k : k + size] for k in range(0, len(fleet), size)]
        yield (
            night,
            [v for part in parts for v in judge_fleet([v.tonight(night, config) for v in part], config)],
        )


@dataclass(frozen=True)
class Made:
    """Vehicles of a run: how days err, how sure they are, how many there are in how large fleets, and the seed."""

    noise: str
    sure: str
    vehicles: int
    fleet: int
    seed: int

    def of(self, case: Case) -> list[Vehicle]:
        """The vehicles to which a case happens."""
        rng = np.random.default_rng([self.seed, *self.noise.encode(), *case.name.encode()])
        return [make_vehicle(self.noise, case, rng, self.sure) for _ in range(self.vehicles)]


def false_alarms(made: Made, days: int) -> dict[str, Any]:
    """RED and any alarm per 1,000 vehicle-nights where nothing happens, from the second night on."""
    config, statuses, reds = AuditConfig(), Counter[str](), Counter[str]()
    for night, verdicts in nights(made.of(Case("nothing", days=days)), range(1, days), config, made.fleet):
        for verdict in verdicts:
            status = status_of_night(verdict, config).status
            statuses.update([status, f"{status} on the last night"] if night == days - 1 else [status])
            reds.update(
                f"{edge.kind} {dof}" for (edge, dof), c in verdict.charts.items() if c.status == "RED"
            )
    count = made.vehicles * (days - 1)
    return {
        "nights": count,
        "red_per_1000": round(1000 * statuses["RED"] / count, 3),
        "alarm_per_1000": round(1000 * (statuses["RED"] + statuses["YELLOW"]) / count, 2),
        "unknown_per_1000": round(1000 * statuses["UNKNOWN"] / count, 2),
        "green_on_the_last_night": round(statuses["GREEN on the last night"] / made.vehicles, 3),
        "red_charts": dict(reds),
    }


def slow_drift(made: Made, case: Case) -> dict[str, Any]:
    """Share of vehicles RED or YELLOW, by the size that a drift has reached; GREEN nights beyond the limit."""
    config, fleet = AuditConfig(), made.of(case)
    rate = float(np.degrees(np.linalg.norm(case.twist[:3])))
    first, named = np.full(made.vehicles, 99), np.full(made.vehicles, 99)
    green = np.zeros(made.vehicles, int)
    for night, verdicts in nights(fleet, range(max(case.on, 1), case.days), config, made.fleet):
        days = night - case.on + (case.on > 0)
        for v, verdict in enumerate(verdicts):
            status = status_of_night(verdict, config)
            if status.status in ("RED", "YELLOW"):
                first[v] = min(first[v], days)
                named[v] = min(named[v], days) if status.sensor == case.sensor else named[v]
            green[v] += status.status == "GREEN" and days * rate > config.camera_lidar_limit_deg + 1e-9
    out = {
        f"alarm_by_{size:.2f}_deg": _share(first * rate <= size + 1e-9)
        for size in (0.1, 0.15, 0.2, 0.25, 0.3)
    }
    out |= {f"named_by_{size:.2f}_deg": _share(named * rate <= size + 1e-9) for size in (0.3, 0.5)}
    return {"vehicles": made.vehicles, **out, "green_nights_beyond_the_limit": int(green.sum())}


def detection(made: Made, case: Case) -> dict[str, Any]:
    """Nights until RED, and until RED with the right sensor; where it started; what comes after a repair or never."""
    config, vehicles, fleet = AuditConfig(), made.vehicles, made.of(case)
    red, right = np.full(vehicles, 99), np.full(vehicles, 99)
    day_right, wrong = np.zeros(vehicles, bool), np.zeros(vehicles, bool)
    green_after = np.full(vehicles, 99)
    red_at_end = np.zeros(vehicles, bool)
    again = case.back or (case.served + 1 if case.served else 0)  # the first day that is well again
    watched = sorted({*range(case.on, case.on + 12), *range(again, again + 12), case.days - 1})
    for night, verdicts in nights(fleet, [n for n in watched if n >= case.on], config, made.fleet):
        for v, verdict in enumerate(verdicts):
            if not any(c.change for c in verdict.charts.values()) and (not again or green_after[v] < 99):
                continue
            status = status_of_night(verdict, config)
            after = night - case.on + 1
            if status.status == "RED" and (not again or night < again):
                red[v] = min(red[v], after)
                wrong[v] |= status.sensor not in (case.sensor, None)
                if status.sensor == case.sensor and right[v] == 99:
                    right[v], day_right[v] = after, is_right_day(verdict, case.on)
            red_at_end[v] = night == case.days - 1 and status.status == "RED"
            if again and night >= again and status.status == "GREEN":
                green_after[v] = min(green_after[v], night - again + 1)
    out = {
        "vehicles": vehicles,
        "red_within_3": _share(red <= 3),
        "right_sensor_within_3": _share(right <= 3),
        "right_sensor_within_5": _share(right <= 5),
        "right_sensor_within_12": _share(right <= 12),
        "wrong_sensor_on_some_night": _share(wrong),
        "median_night": float(np.median(right)),
        "day_right_within_1": _share(day_right[right < 99]) if (right < 99).any() else None,
        "red_on_the_last_night": _share(red_at_end),
    }
    return out | ({f"green_within_{n}": _share(green_after <= n) for n in (5, 8, 12)} if again else {})


def is_right_day(verdict: VehicleVerdict, day: int) -> bool:
    """Whether the clearest RED chart says the day, to one day or, where days are lost, within its interval."""
    red = [c for c in verdict.charts.values() if c.status == "RED" and c.change is not None]
    change = max(red, key=lambda c: (c.statistic or 0) / (c.threshold or 1)).change
    assert change is not None, "charts without a change were left out"
    return abs(change.day - day) <= 1 or change.earliest <= day <= change.latest


def _share(found: np.ndarray) -> float:
    return round(float(np.mean(found)), 3)


def main() -> None:
    """Run what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicles", type=int, default=1000)
    parser.add_argument("--nights", type=int, default=100)
    parser.add_argument("--days", choices=list(VARYING), default="real")
    parser.add_argument("--fleet", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=64_000)
    parser.add_argument("--tune", type=int, default=-1, metavar="SEED")
    parser.add_argument("--only", default="")
    parser.add_argument("--noise", nargs="+", default=list(NOISES))
    args = parser.parse_args()
    seed = args.first_seed if args.tune < 0 else args.tune
    lines = [json.loads(line) for line in RESULTS.read_text().splitlines()] if args.tune < 0 else []
    known = {(r["noise"], r["case"], r["seed"]) for r in lines}
    for case in (c for c in CASES if args.only in c.name):
        for noise in (n for n in args.noise if (n, case.name, seed) not in known):
            begun, vehicles = time.process_time(), args.vehicles // 10 if case.sensor else args.vehicles
            fleet = 2 if "of two vehicles" in case.name else args.fleet
            made = Made(noise, args.days, max(vehicles, 20), fleet, seed)
            found = (
                (slow_drift if case.slow else detection)(made, case)
                if case.sensor
                else false_alarms(made, args.nights)
            )
            line = {"noise": noise, "case": case.name, "days": args.days, "fleet": fleet, "seed": seed}
            line |= {"commit": commit_now(), **found, "cpu_s": round(time.process_time() - begun, 1)}
            print(json.dumps(line), flush=True)
            if args.tune < 0:
                with RESULTS.open("a") as file:
                    file.write(json.dumps(line) + "\n")


if __name__ == "__main__":
    main()

"""What the charts of `boresight audit` find of a sensor that moved, where days err as accepted records say they do.

`drift_charts` assumes camera-lidar days of .02 deg. Here a vehicle's days take their covariances from accepted records
(of the demo's rig, of the real car), each day another one, and a tenth of a fleet, one at least, moves while the others
stay.

    python -m tests.benchmarks.studies.drift_power gather --name demo --fleet F --lake LAKE
    python -m tests.benchmarks.studies.drift_power gather --name "real car" --fleet F --lake LAKE --parts
    python -m tests.benchmarks.studies.drift_power run [--movers 40] [--first-seed 63000]

`gather` keeps covariances of a lake's days in results/day_covariances.json, `run` writes drift_power.jsonl and .md.
Fleets are judged whole, as the audit does, on nights 1 to 5 and 12 after the step. Seeds below 200 are for tuning and
write nothing.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.audit.days import PairDays, pair_days
from pipeline.calibrate.day import calibrate_observations
from pipeline.calibrate.records import Inputs
from pipeline.config import AuditConfig, FleetConfig, load_fleet
from pipeline.errors import SolveError
from pipeline.extrinsics.prior import read_prior
from pipeline.geometry.se3 import adjoint, exp_se3, inverse
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of, perceived_days
from schemas.calibrations import PAIRS
from schemas.observations import Observation
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.drift_charts import CASES, Case, Vehicle, status_of_night
from tests.benchmarks.studies.drift_charts import nights as judged_nights
from tests.benchmarks.studies.metrics import transform_of

RESULTS = Path("tests/benchmarks/results/drift_power.jsonl")
RECORDS = Path("tests/benchmarks/results/day_covariances.json")
FLEETS = (2, 20, 200)
PHIS = (0.0, 0.3, 0.6)  # autocorrelation of days' errors
MOVED = ("camera yaw .3", "camera pitch .3", "radar yaw .5", "radar pitch .5")
NIGHTS = (1, 2, 3, 4, 5, 12)  # after the step
_MOST_MOVERS = 0.1  # share of a fleet that moves at once, but one at least
_DAYS = 60
_OWN = ("camera_lidar", "lidar_radar")  # camera_radar is composed of them


@dataclass(frozen=True, eq=False)
class Records:
    """Accepted records of one rig: where its sensors are, and covariances of its days (left perturbations).

    Args:
        T: by pair.
        varying: by pair (N, 6, 6), what differs from day to day.
        common: by pair (N, 6, 6), what all days err by alike.
        observable: by pair (N, 6), what each day determined; camera_radar too.
    """

    T: dict[str, np.ndarray]
    varying: dict[str, np.ndarray]
    common: dict[str, np.ndarray]
    observable: dict[str, np.ndarray]

    def turn_sigmas_deg(self, pair: str) -> list[float]:
        """Median over records of the sigmas of rx, ry, rz that vary."""
        sigmas = np.sqrt(np.einsum("nii->ni", self.varying[pair]))[:, :3]
        return [round(float(v), 3) for v in np.degrees(np.median(sigmas, axis=0))]


def read_records(name: str, path: Path = RECORDS) -> Records:
    """Records that `gather` wrote under a name."""
    mine = [r for r in json.loads(path.read_text())["records"] if r["name"] == name]
    if not mine:
        raise SystemExit(f"{path} has no records of {name!r}: gather them first")

    def stacked(pair: str, key: str) -> np.ndarray:
        return np.array([r["pairs"][pair][key] for r in mine])

    T = {pair: stacked(pair, "T")[0] for pair in _OWN}
    common = {pair: stacked(pair, "common") for pair in _OWN}
    varying = {pair: stacked(pair, "covariance") - common[pair] for pair in _OWN}
    return Records(T, varying, common, {pair: stacked(pair, "observable") for pair in PAIRS})


def make_vehicle(records: Records, phi: float, case: Case, rng: np.random.Generator) -> Vehicle:
    """A vehicle whose every day has the covariance of a record drawn for it; errors AR(1) in its sigmas."""
    drawn = rng.integers(0, len(records.varying["camera_lidar"]), case.days)
    moved = np.zeros((case.days, 6))
    moved[case.on :] = case.twist
    still = np.zeros((case.days, 6))
    M = {s: exp_se3(moved if s == case.sensor else still) for s in ("camera", "lidar", "radar")}
    clean = {
        "camera_lidar": inverse(M["camera"]) @ records.T["camera_lidar"] @ M["lidar"],
        "lidar_radar": inverse(M["lidar"]) @ records.T["lidar_radar"] @ M["radar"],
    }
    T, varying, common = {}, {}, {}
    for pair in _OWN:
        varying[pair] = records.varying[pair][drawn]
        common[pair] = np.broadcast_to(records.common[pair].mean(axis=0), varying[pair].shape)
        daily = np.einsum("nij,nj->ni", _roots(varying[pair]), _autocorrelated(phi, case.days, rng))
        T[pair] = exp_se3(daily + _roots(common[pair][0]) @ rng.normal(size=6)) @ clean[pair]
    T["camera_radar"] = T["camera_lidar"] @ T["lidar_radar"]
    A = adjoint(records.T["camera_lidar"])
    for part in (varying, common):
        part["camera_radar"] = part["camera_lidar"] + A @ part["lidar_radar"] @ A.T
    seen = {pair: records.observable[pair][drawn] for pair in PAIRS}
    return Vehicle({pair: _days(T[pair], varying[pair], common[pair], seen[pair]) for pair in PAIRS})


def _days(T: np.ndarray, varying: np.ndarray, common: np.ndarray, observable: np.ndarray) -> PairDays:
    every = np.ones(len(T), bool)
    return pair_days(np.arange(len(T)), T, varying + common, np.asarray(common), observable, every)


def _roots(covariance: np.ndarray) -> np.ndarray:
    """A matrix square root of each covariance; those of rank less than six (a floor of turns alone) have one too."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def _autocorrelated(phi: float, days: int, rng: np.random.Generator) -> np.ndarray:
    """AR(1) errors (days, 6) of variance 1."""
    e = rng.normal(size=(days, 6))
    for k in range(1, days):
        e[k] = phi * e[k - 1] + np.sqrt(1 - phi**2) * e[k]
    return e


def power(
    records: Records, phi: float, case: Case, size: int, movers: int, seed: Sequence[int]
) -> dict[str, Any]:
    """Vehicles that moved and were RED, with the right sensor, by the third, fifth and twelfth night; false REDs.

    Args:
        records: that days are drawn from.
        phi: autocorrelation of days.
        case: what moves.
        size: vehicles of a fleet.
        movers: in all fleets together, at least so many.
        seed: of everything.
    """
    config, rng = AuditConfig(), np.random.default_rng(list(seed))
    each = max(1, round(_MOST_MOVERS * size))
    fleets = -(-movers // each)
    quiet = Case("nothing", days=_DAYS)
    red, right = np.full(fleets * each, 99), np.full(fleets * each, 99)
    wrong, false, watched = np.zeros(fleets * each, bool), 0, 0
    for f in range(fleets):
        fleet = [make_vehicle(records, phi, case if v < each else quiet, rng) for v in range(size)]
        for night, verdicts in judged_nights(fleet, [case.on - 1 + n for n in NIGHTS], config):
            after = night - case.on + 1
            for v, verdict in enumerate(verdicts):
                found = any(c.change for c in verdict.charts.values())
                status = status_of_night(verdict, config) if found else None
                is_red = status is not None and status.status == "RED"
                if v >= each:
                    watched, false = watched + 1, false + is_red
                elif is_red and status is not None:
                    at = f * each + v
                    red[at] = min(red[at], after)
                    wrong[at] |= status.sensor not in (case.sensor, None)
                    right[at] = min(right[at], after) if status.sensor == case.sensor else right[at]
    out: dict[str, Any] = {"movers": len(red), "wrong_sensor": int(wrong.sum())}
    for n in (3, 5, 12):
        out |= {f"red_within_{n}": int((red <= n).sum()), f"right_within_{n}": int((right <= n).sum())}
    return out | {"others_nights": watched, "others_red": false}


def _cases() -> list[Case]:
    known = {case.name: case for case in CASES}
    return [Case(n, known[n].sensor, known[n].twist, on=40, days=_DAYS) for n in MOVED]


def run(args: argparse.Namespace) -> None:
    """All combinations that have no line yet, then the table."""
    lines = [json.loads(x) for x in RESULTS.read_text().splitlines()] if RESULTS.exists() else []
    done = {_key(line) for line in lines}
    combinations = [
        {"records": name, "phi": phi, "fleet": size, "case": case.name, "seed": args.first_seed}
        for case in _cases()
        for size in args.fleets
        for name in args.names
        for phi in PHIS
    ]
    for about in combinations:
        if _key(about) in done:
            continue
        began, records = time.process_time(), read_records(about["records"])
        seed = [
            about["seed"],
            FLEETS.index(about["fleet"]),
            round(10 * about["phi"]),
            *about["records"].encode(),
        ]
        [case] = [c for c in _cases() if c.name == about["case"]]
        found = power(records, about["phi"], case, about["fleet"], args.movers, seed)
        line = about | {"commit": commit_now(), "date": time.strftime("%Y-%m-%d")} | found
        line |= {"sigmas_deg": {pair: records.turn_sigmas_deg(pair) for pair in _OWN}}
        line |= {"cpu_s": round(time.process_time() - began, 1)}
        print(json.dumps(line), flush=True)
        if about["seed"] >= 200:
            lines.append(line)
            with RESULTS.open("a") as file:
                file.write(json.dumps(line) + "\n")
    if lines:
        RESULTS.with_suffix(".md").write_text(table(lines))


def _key(line: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(line[name] for name in ("records", "phi", "fleet", "case", "seed"))


def table(lines: Sequence[dict[str, Any]]) -> str:
    """Per rig, autocorrelation and fleet: share that is RED with the right sensor within 3, 5 and 12 nights."""
    out = [
        (
            "RED with the right sensor within 3 / 5 / 12 nights [%], of the vehicles that moved (their number in "
            f"brackets); seeds {', '.join(sorted({str(r['seed']) for r in lines}))}, commit "
            f"{', '.join(sorted({r['commit'] for r in lines}))}. Last: REDs per 1,000 nights of "
            "vehicles that did not move."
        ),
        "",
        f"| days of | sigma of camera-lidar rx/ry/rz [deg] | AR | fleet | {' | '.join(MOVED)} | false RED |",
        "|---|---|---|---|" + "---|" * (len(MOVED) + 1),
    ]
    groups: dict[tuple[Any, ...], dict[str, dict[str, Any]]] = {}
    for r in lines:
        groups.setdefault((r["records"], r["phi"], r["fleet"]), {})[r["case"]] = r
    for (name, phi, size), by_case in sorted(groups.items()):
        cells = [_cell(by_case[case]) if case in by_case else "-" for case in MOVED]
        sigmas = "/".join(f"{s:.3f}" for s in next(iter(by_case.values()))["sigmas_deg"]["camera_lidar"])
        quiet = sum(r["others_nights"] for r in by_case.values())
        false = 1000 * sum(r["others_red"] for r in by_case.values()) / max(quiet, 1)
        out.append(f"| {name} | {sigmas} | {phi:g} | {size} | {' | '.join(cells)} | {false:.2f} of {quiet} |")
    return "\n".join(out) + "\n"


def _cell(line: dict[str, Any]) -> str:
    shares = " / ".join(f"{100 * line[f'right_within_{n}'] / line['movers']:.0f}" for n in (3, 5, 12))
    return f"{shares} ({line['movers']})"


def gather(args: argparse.Namespace) -> None:
    """Calibrate a lake's days (with `--parts` their halves too); keep covariances of those accepted whole."""
    fleet, lake = load_fleet(args.fleet), Lake.at(args.lake)
    known = json.loads(RECORDS.read_text())["records"] if RECORDS.exists() else []
    found = [r for r in known if r["name"] != args.name]
    for partition in perceived_days(lake):
        rows = list(observations_of(lake, partition))
        for part, chosen in _parts(rows, halves=args.parts):
            found += _accepted(chosen, fleet, partition, {"name": args.name, "part": part})
    RECORDS.write_text(json.dumps({"commit": commit_now(), "records": found}) + "\n")


def _parts(rows: list[Observation], *, halves: bool) -> Iterator[tuple[str, list[Observation]]]:
    yield "day", rows
    if halves:
        half = len(rows) // 2
        yield from {"even": rows[::2], "odd": rows[1::2], "first": rows[:half], "second": rows[half:]}.items()


def _accepted(
    rows: list[Observation], fleet: FleetConfig, partition: Partition, about: dict[str, str]
) -> list[dict[str, Any]]:
    """The record's covariances where both pairs were accepted, as a list of one; else an empty one."""
    try:
        prior = read_prior(rows, fleet, partition.vehicle)
        records = calibrate_observations(rows, prior, fleet, Inputs(partition, "joint", "study", 0, ()))
    except SolveError as err:
        print(partition, about["part"], err.reason)
        return []
    by = {r.pair: r for r in records if r.status == "accepted"}
    print(partition, about["part"], {r.pair: r.status for r in records}, flush=True)
    if any(pair not in by for pair in PAIRS):
        return []
    pairs = {}
    for pair, record in by.items():
        T, covariance, common = transform_of(record), record.covariance, record.common_covariance
        assert T is not None, pair
        assert covariance is not None, pair
        assert common is not None, pair
        pairs[pair] = {"T": T.tolist(), "covariance": covariance.tolist(), "common": common.tolist()}
        pairs[pair]["observable"] = [bool(v) for v in record.observable or []]
    return [{**about, "vehicle": partition.vehicle, "day": partition.day, "pairs": pairs}]


def main() -> None:
    """Gather records, or run what is missing."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    gathering = commands.add_parser("gather")
    gathering.add_argument("--name", required=True)
    gathering.add_argument("--fleet", type=Path, required=True)
    gathering.add_argument("--lake", required=True)
    gathering.add_argument("--parts", action="store_true")
    gathering.set_defaults(do=gather)
    running = commands.add_parser("run")
    running.add_argument("--movers", type=int, default=40)
    running.add_argument("--first-seed", type=int, default=63_000)
    running.add_argument("--names", nargs="+", default=["demo", "real car"])
    running.add_argument("--fleets", nargs="+", type=int, choices=FLEETS, default=list(FLEETS))
    running.set_defaults(do=run)
    args = parser.parse_args()
    args.do(args)


if __name__ == "__main__":
    main()

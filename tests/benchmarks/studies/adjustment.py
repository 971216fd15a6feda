"""Study: one adjustment over the graph in the place of composition, on rigs of three sensors.

    python tests/benchmarks/studies/adjustment.py FOLDER... [--seeds 1 2] [--out RESULTS.jsonl]

Each FOLDER holds a simulated day: fleet.toml, truth/, lake/ ingested and perceived (`days.py generate` and the fault
days are so). A real day is given as LAKE:FLEET:VEHICLE:DAY; its logged calibration stands in for the truth. Days are
solved from a prior 2 deg and 5 cm off, three ways: `today` (camera-radar composed, what rests on a pair that is not
accepted solved again), `boxes in lidar-radar` and `boxes in camera-radar` (evidence of three edges, adjusted; an edge
that is not accepted is left out and the rest adjusted again). Verdicts, errors and sigmas are those of records.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from pipeline.calibrate.adjust.adjusted import AdjustedRig, AdjustmentLimits
from pipeline.calibrate.adjust.evidence import evidence_of
from pipeline.calibrate.adjust.rig import adjust
from pipeline.calibrate.adjust.three import EDGES, poses_of, three_sensors
from pipeline.calibrate.joint.camera_radar import estimate_camera_radar
from pipeline.calibrate.joint.solve import _Day, solve_joint
from pipeline.calibrate.numerics.covariance import OBSERVABLE
from pipeline.calibrate.records import Inputs
from pipeline.calibrate.stage import calibrate_observations
from pipeline.config import SolveConfig, load_fleet
from pipeline.errors import SolveError
from pipeline.extrinsics.checks import FailedCheck
from pipeline.extrinsics.estimates import PairEstimate, Prior, Solution
from pipeline.extrinsics.prior import perturbed, read_prior
from pipeline.results import Progress, silent
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.calibrations import PAIRS
from schemas.observations import Observation
from tests.benchmarks.studies.days import DATE, VEHICLE, Day
from tests.benchmarks.studies.metrics import LIMITS_DEG, measure

Found = tuple[PairEstimate, list[FailedCheck]]
WAYS = ("today", "boxes in lidar-radar", "boxes in camera-radar")


@dataclass(frozen=True, eq=False)
class Adjusted:
    """`solve_joint` with the adjustment in the place of composition: a solver of `calibrate_observations`."""

    boxes_in_lidar_radar: bool
    rigs: list[AdjustedRig] = field(default_factory=list)  # of each round

    def __call__(
        self,
        observations: Mapping[str, Sequence[Observation]],
        prior: Prior,
        config: SolveConfig,
        *,
        seed: int,
        triggered: Sequence[str] = PAIRS,
        progress: Progress = silent,
    ) -> Solution:
        """Evidence of the pairs that have frames, adjusted."""
        joint = solve_joint(observations, prior, config, seed=seed, triggered=triggered, progress=progress)
        assert joint.without is not None
        day: _Day = joint.without.__self__  # type: ignore[attr-defined]
        return self.solved(day, frozenset())

    def solved(self, day: _Day, disbelieved: frozenset[str]) -> Solution:
        """The rig without the edges of disbelieved pairs."""
        found = self._estimates(day, disbelieved)
        sigma_s = day.config.time_offset_sigma_s
        gone = [FailedCheck("its pair is not accepted")]
        evidence = [
            evidence_of(e, EDGES[p], day.prior, sigma_s, [*checks, *(gone if p in disbelieved else [])])
            for p, (e, checks) in found.items()
        ]
        expected = {p: found[p][0].time_offset_prior_s or 0.0 for p in found}
        dt_s = {"camera": -expected.get("camera_lidar", 0.0), "radar": expected.get("lidar_radar", 0.0)}
        rig = adjust(three_sensors(found), poses_of(day.prior, dt_s), evidence, AdjustmentLimits(sigma_s))
        self.rigs.append(rig)
        pairs, failed = {}, {}
        for pair in (p for p in PAIRS if p in found):
            at, (own, checks) = rig.edges[EDGES[pair]], found[pair]
            lost = pair != "camera_radar" and not at.used
            pairs[pair] = own if lost else _of_rig(own, rig)
            failed[pair] = [*checks, *(c for c in at.failed if c not in gone and c not in checks)]
        failed["camera_radar"] = [
            *failed.get("camera_lidar", []), *failed.get("lidar_radar", []), *failed.get("camera_radar", []),
        ]  # fmt: skip
        failed = {p: checks for p, checks in failed.items() if checks and p in pairs}
        return Solution("joint", pairs, None, None, failed, lambda more: self.solved(day, more))

    def _estimates(self, day: _Day, disbelieved: frozenset[str]) -> dict[str, Found]:
        """Each pair alone; with the camera's boxes in lidar-radar only where they are to be there."""
        found: dict[str, Found] = {}
        helped = self.boxes_in_lidar_radar and day._camera_helps(disbelieved)
        if "lidar_radar" in day.observations:
            found["lidar_radar"] = day._once(
                ("lidar_radar", helped, self.boxes_in_lidar_radar), lambda: self._lidar_radar(day, helped)
            )
        if "camera_lidar" in day.observations:
            headed = "lidar_radar" in found and "lidar_radar" not in disbelieved
            along = found["lidar_radar"][0] if headed else None
            found["camera_lidar"] = day._once(
                ("camera_lidar", helped, headed, self.boxes_in_lidar_radar), lambda: day._camera_lidar(along)
            )
        if "camera_radar" in day.observations:
            rng = np.random.default_rng([day.seed, 2])
            boxes = not helped
            found["camera_radar"] = day._once(
                ("camera_radar", boxes, "adjusted"),
                lambda: (
                    estimate_camera_radar(
                        day.observations["camera_radar"], day.prior, day.config, rng, boxes=boxes
                    ),
                    [],
                ),
            )
        return found

    def _lidar_radar(self, day: _Day, helped: bool) -> Found:
        if self.boxes_in_lidar_radar:
            return day._lidar_radar(helped)
        blind = replace(day, config=day.config.model_copy(update={"terms": _without(day.config.terms)}))
        return blind._lidar_radar(False)


def _without(terms: Sequence[str]) -> tuple[str, ...]:
    return tuple(t for t in terms if t != "boxes")


def _of_rig(own: PairEstimate, rig: AdjustedRig) -> PairEstimate:
    """A pair's estimate with the adjusted pose; what its own frames tell beside it stays."""
    parent, child = own.pair.split("_")
    T = rig.poses.between(parent, child)
    observability = rig.observability(parent, child)
    return replace(
        own,
        T=T,
        covariance=rig.poses.covariance_between(parent, child),
        common_covariance=rig.poses.covariance_between(parent, child, common=True),
        observability=observability,
        observable=observability >= OBSERVABLE,
    )


def solve_day(
    name: str, rows: list[Observation], fleet: Any, prior: Prior, truth: Mapping[str, Any], seed: int
) -> dict[str, Any]:
    """Records of all ways against truth."""
    out: dict[str, Any] = {"day": name, "seed": seed}
    day = SimpleNamespace(truth=truth, true_of=lambda pair: np.array(truth[f"T_{pair}"], np.float64))
    about = Inputs(Partition(VEHICLE, DATE), "joint", "study", seed, ())
    for way in WAYS:
        solver = None if way == "today" else Adjusted(way == "boxes in lidar-radar")
        records = calibrate_observations(rows, prior, fleet, about, solver=solver)
        out[way] = {
            r.pair: measure(r, Day.pointing_of(day, r.pair), prior, None)
            | {"determined": list(r.determined or [])}
            for r in records
        }
        if solver is not None:
            rig = solver.rigs[-1]
            out[way]["left out"] = [e.name for e in rig.left_out]
            out[way]["innovations"] = {e.kind: f.innovation_sigmas for e, f in rig.edges.items()}
    return out


def day_of(given: str) -> tuple[str, list[Observation], Any, Prior, dict[str, Any]]:
    """Rows, configuration, logged prior and truth of a folder or a real day."""
    if given.count(":") >= 3:
        lake, toml, vehicle, date = given.split(":")[:4]
        fleet = load_fleet(Path(toml))
        rows = list(observations_of(Lake.at(Path(lake)), Partition(vehicle, date)))
        prior = read_prior(rows, fleet, vehicle)
        truth = {f"T_{p}": prior.of(p).tolist() for p in PAIRS}
        if given.count(":") == 4:
            truth = json.loads(Path(given.split(":")[4]).read_text())
            product = np.array(truth["T_camera_lidar"]) @ np.array(truth["T_lidar_radar"])
            truth["T_camera_radar"] = product.tolist()
        return f"{vehicle}", rows, fleet, prior, truth
    folder = Path(given)
    fleet = load_fleet(folder / "fleet.toml")
    rows = list(observations_of(Lake.at(folder / "lake"), Partition(VEHICLE, DATE)))
    truth = json.loads((folder / "truth" / VEHICLE / f"{DATE}.json").read_text())
    return folder.name, rows, fleet, read_prior(rows, fleet, VEHICLE), truth


def main() -> None:
    """Solve what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("days", nargs="*")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--perturb", type=float, nargs=2, default=(2.0, 0.05))
    parser.add_argument("--out", type=Path, default=Path("adjustment.jsonl"))
    args = parser.parse_args()
    known = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    for given in args.days:
        name, rows, fleet, logged, truth = day_of(given)
        for seed in args.seeds:
            if any((k["day"], k["seed"]) == (name, seed) for k in known):
                continue
            prior = perturbed(logged, tuple(args.perturb) if args.perturb[0] else None, seed)
            try:
                known.append(solve_day(name, rows, fleet, prior, truth, seed))
            except SolveError as err:
                print(f"{name} {seed}: {err.reason}")
                continue
            with args.out.open("a") as file:
                file.write(json.dumps(known[-1], default=float) + "\n")
    print(table(known))


def table(results: Sequence[Mapping[str, Any]]) -> str:
    """By way and pair: errors, sigmas, verdicts."""
    lines = [
        "| way | pair | days | azimuth, elevation RMS deg | turns: error/sigma RMS | accepted | wrong | left out |"
    ]
    lines.append("|---|---|---|---|---|---|---|---|")
    for way in WAYS:
        for pair in PAIRS:
            mine = [r[way][pair] for r in results if pair in r[way] and "az_deg" in r[way][pair]]
            if not mine:
                continue
            az, el = (np.sqrt(np.mean(np.square([m[k] for m in mine]))) for k in ("az_deg", "el_deg"))
            z = np.array([np.array(m["error"][:3]) / np.array(m["sigma"][:3]) for m in mine])
            accepted = [m for m in mine if m["status"] == "accepted"]
            asked = ("az_deg", "el_deg") if pair == "camera_lidar" else ("az_deg",)
            wrong = sum(max(m[k] for k in asked) > LIMITS_DEG[pair] for m in accepted)
            gone = sum(pair.replace("_", "-") in r[way].get("left out", []) for r in results)
            lines.append(
                f"| {way} | {pair} | {len(mine)} | {az:.3f}, {el:.3f} | {np.round(np.sqrt((z**2).mean(0)), 2)} "
                f"| {len(accepted)} | {wrong} | {gone} |"
            )
    return "\n".join([*lines, "", *_changes(results)])


def _changes(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Verdicts that differ from today's."""
    lines = []
    for r in results:
        for way in WAYS[1:]:
            for pair in PAIRS:
                a, b = r["today"].get(pair, {}), r[way].get(pair, {})
                if a.get("status") != b.get("status"):
                    reason = b.get("reason") or a.get("reason")
                    lines.append(
                        f"{r['day']} {r['seed']} {way} {pair}: {a.get('status')} -> {b.get('status')}: {reason}"
                    )
    return lines


if __name__ == "__main__":
    main()

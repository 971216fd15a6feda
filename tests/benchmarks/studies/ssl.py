"""Study: networks that learn on a car's own logs, tested on a log and on days that they never saw.

    python -m tests.benchmarks.studies.ssl --root DAYS [--parts real fleet] [--networks trained ...] [--out FILE]

`real`: the real car's logs 00 to 02 teach, 03 is the test; and 03, 02, 01 teach, 00 is the test; four draws, 2 deg
and 0.2 m off. `fleet`: six days of a drawn rig in its world teach, four others are the test. Of each network there
is a line per test and draw, with the CPU seconds of a step and the training's peak memory. All take the
same steps; a network of one pair cannot begin with the shipped one, so one of all pairs begins with nothing too.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibrate.networks import calibrate_frame
from pipeline.core.config import load_fleet
from pipeline.core.stage_work import Task
from pipeline.core.stages import CALIBRATE
from pipeline.rig.day_prior import read_transforms
from pipeline.rig.targets import DEFAULT_TARGETS, errors_at_targets
from pipeline.simulate.fleet import FleetSpec, day_names, simulate_fleet
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_columns
from schemas.calibrations import PAIRS
from schemas.moments import PERCEIVED
from tests.benchmarks.results_measures import errors, wrong_records
from tests.benchmarks.studies import real
from tests.benchmarks.studies.commits import commit_now, is_accepted
from tests.benchmarks.studies.engine import RESULTS, boresight
from tests.benchmarks.studies.looks import look
from tests.benchmarks.studies.run import table

RECIPES = Path(__file__).parent / "ssl_recipes"
SHIPPED = Path("pipeline/learn/models/joint_classes.onnx")
STEPS, DRAWS, OFF, FIRST_DAY, PAIRWISE = 240, 4, (2.0, 0.2), "2026-03-02", "pairwise from nothing"
FRAMES, ABRUPT_DEG = 16, 10.0
SPLITS = (("00", "01", "02", "03"), ("03", "02", "01", "00"))  # the last one is the test
SEED, TAUGHT, TESTED = 7511, 6, 4  # of the drawn rig and world: fresh for each release
# Recipe, what it changes, and whether it begins with the shipped network; of `pairwise` each pair has one of its own.
NETWORKS: dict[str, tuple[str, str, bool]] = {
    "trained": ("rigs_real.toml", "", True),
    "without the loop": ("rigs_real.toml", "loss = { loop = 0.0 }\n", True),
    "from nothing": ("rigs_real.toml", "", False),
    PAIRWISE: ("rigs_real.toml", "", False),
    "the paper's recipe": ("paper_joint.toml", "", False),
}


@dataclass(frozen=True)
class Part:
    """Days that teach, days of the test, and the truth or the given calibration of each of these."""

    name: str
    fleet: Path
    folder: Path
    taught: Sequence[Partition]
    truth: dict[Partition, dict[str, np.ndarray]]
    draws: int
    seed: int = 0


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of the lakes and runs")
    parser.add_argument("--shared", type=Path, default=real.SHARED, help="folder of the data and models")
    parser.add_argument("--parts", nargs="+", choices=["real", "fleet"], default=["real", "fleet"])
    parser.add_argument(
        "--networks", nargs="+", choices=["untrained", *NETWORKS], default=["untrained", *NETWORKS]
    )
    parser.add_argument("--out", type=Path, default=RESULTS / "ssl.jsonl")
    args = parser.parse_args()
    parts = []
    logs = args.shared / "data" / "astyx"
    if "real" in args.parts and logs.is_dir():
        parts += [_real(args.root / f"ssl-real-{split[-1]}", logs, *split) for split in SPLITS]
    parts += [_fleet(args.root / f"ssl-fleet-{SEED}")] if "fleet" in args.parts else []
    known = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    lines = [r for r in known if is_accepted(r["commit"], commit_now(), ())]
    for part in parts:
        for name in ["joint", *args.networks]:
            row, of_frames = f"{part.name}: {name}", name in ("untrained", "trained")
            if not any(r["row"] == row for r in lines):
                cost = {} if name in ("joint", "untrained") else _trained(part, name)
                found = [{"row": row, "commit": commit_now()} | cost | r for r in _tested(part, name)]
                lines += _kept(args.out, found)
            row += ", single frames"
            if of_frames and not any(r["row"] == row for r in lines):
                found = [{"row": row, "commit": commit_now()} | r for r in _single_frames(part, name)]
                lines += _kept(args.out, found)
    sys.stdout.write(f"{look('ssl', [r for r in lines if r['day']['seed']])}\n\n{_table(lines)}\n")


def _kept(out: Path, found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    with out.open("a") as file:
        file.writelines(json.dumps(r) + "\n" for r in found)
    return found


def _real(folder: Path, logs: Path, *split: str) -> Part:
    """Three logs of the car and the fourth, each side as one day."""
    for name, numbers in (("taught", split[:-1]), ("tested", split[-1:])):
        named = [p for n in numbers for p in sorted(logs.glob(f"{real.DAY.vehicle}_*_{n}*"))]
        real.perceived_lake(folder / name, real.FLEET, real.DAY, named)
    given = {real.DAY: dict(read_transforms(logs / "given_calibration.json"))}
    return Part(f"log {split[-1]}", real.FLEET, folder, [real.DAY], given, DRAWS)


def _fleet(folder: Path) -> Part:
    """Days of one drawn car in its world: the first ones teach."""
    days = [Partition("vehicle-1", day) for day in day_names(FIRST_DAY, TAUGHT + TESTED)]
    if not (folder / "fleet.toml").exists():
        spec = FleetSpec(
            vehicles=1, days=len(days), first_day=FIRST_DAY, frames=60, rig=f"random-{SEED}",
            environments=f"world-{SEED}", seed=SEED,
        )  # fmt: skip
        simulate_fleet(spec, folder)
    truth = {}
    for k, day in enumerate(days):
        logs = sorted((folder / "logs" / day.vehicle / day.day).iterdir())
        real.perceived_lake(folder / ("taught" if k < TAUGHT else "tested"), folder / "fleet.toml", day, logs)
        known = json.loads((folder / "truth" / day.vehicle / f"{day.day}.json").read_text())
        truth[day] = {pair: np.array(known[f"T_{pair}"]) for pair in PAIRS}
    tested = {day: truth[day] for day in days[TAUGHT:]}
    return Part("fleet", folder / "fleet.toml", folder, days[:TAUGHT], tested, 1, SEED)


def _trained(part: Part, name: str) -> dict[str, float]:
    """Train and export; CPU seconds a step (start and validation included) and peak memory [MB]."""
    folder = part.folder / "taught"
    if not (folder / "training").exists():
        for day in part.taught:
            CALIBRATE.run(Task(load_fleet(part.fleet), Lake.at(folder), day, "joint"))
        boresight("prepare", "--fleet", part.fleet, "--lake", folder, "--executor", "inline")
    recipe, changed, is_begun = NETWORKS[name]
    used = []
    for pairs, model in _models(part, name).items():
        run, config = model.with_suffix(""), model.with_suffix(".toml")
        shutil.rmtree(run, ignore_errors=True)
        run.parent.mkdir(parents=True, exist_ok=True)
        left_out = ("budget_", "pairs", *(("takes_classes", "marks") if pairs == "lidar_radar" else ()))
        rows = (RECIPES / recipe).read_text().splitlines()
        config.write_text("\n".join([changed, *(r for r in rows if not r.startswith(left_out))]))
        begin = ("--start-from", SHIPPED) if is_begun else ()
        what = ("--data", folder, "--out", run, "--config", config, "--steps", STEPS, "--pairs", pairs)
        used.append(boresight("train", *what, *begin))
        boresight("export", "onnx", "--run", run, "--out", model)
    cpu_s, peak_mb = zip(*used, strict=True)
    return {"steps": STEPS, "cpu_s_a_step": sum(cpu_s) / STEPS, "peak_mb": max(peak_mb)}


def _models(part: Part, name: str) -> dict[str, Path]:
    """Files of a network by what it is for: all pairs, or one."""
    folder = (part.folder / name.replace(" ", "-").replace("'", "")).resolve()
    return {pairs: folder / f"{pairs}.onnx" for pairs in (PAIRS if name == PAIRWISE else ("joint",))}


def _tested(part: Part, name: str) -> list[dict[str, Any]]:
    method = {"joint": "joint", PAIRWISE: "pairwise-ssl"}.get(name, "joint-ssl")
    fleet = load_fleet(part.fleet)
    if name in NETWORKS:
        files = {pairs: str(file) for pairs, file in _models(part, name).items()}
        fleet = fleet.changed(
            learn={"pairwise_models": files} if name == PAIRWISE else {"model": files["joint"]}
        )
    lake, found = Lake.at(part.folder / "tested"), []
    for (day, truth), draw in product(part.truth.items(), range(part.draws)):
        pairs = real.calibrated(fleet, lake, day, method, OFF, draw, truth)
        found.append({"day": {"day": day.day, "seed": part.seed}, "seed": draw, "pairs": pairs})
    return found


def _single_frames(part: Part, name: str) -> list[dict[str, Any]]:
    """Single frames of the test, from priors `ABRUPT_DEG` off: the paper's figure 4."""
    fleet, lake, found = load_fleet(part.fleet), Lake.at(part.folder / "tested"), []
    if name in NETWORKS:
        fleet = fleet.changed(learn={"model": str(_models(part, name)["joint"])})
    for day, truth in part.truth.items():
        frames = read_columns(lake, PERCEIVED, day, ["moment"])["moment"]
        for k in np.linspace(0, len(frames) - 1, FRAMES).astype(int).tolist():
            task = Task(fleet, lake, day, "joint-ssl", perturb=(ABRUPT_DEG, OFF[1]), seed=k)
            pairs = {}
            for pair, of in calibrate_frame(task, int(frames[k])).solution.pairs.items():
                off = np.degrees(errors_at_targets(pair, of.T, truth[pair], DEFAULT_TARGETS)[:2])
                pairs[pair] = {"status": "held", "az_deg": float(off[0]), "el_deg": float(off[1])}
            found.append({"day": {"day": day.day, "seed": part.seed}, "seed": k, "pairs": pairs})
    return found


def _table(lines: Sequence[dict[str, Any]]) -> str:
    """Of each network errors by pair, accepted records, those of them that are wrong, cost."""
    body = []
    for row in dict.fromkeys(r["row"] for r in lines):
        own = [r for r in lines if r["row"] == row]
        cost = f"{own[0]['cpu_s_a_step']:.2f} s, {own[0]['peak_mb']:.0f} MB" if "peak_mb" in own[0] else "-"
        known = [pair for pair in PAIRS if sum("az_deg" in r["pairs"].get(pair, {}) for r in own) > 1]
        cells = [errors(own, {"pairs": [pair]}) if pair in known else "-" for pair in PAIRS]
        body.append([row, *cells, wrong_records(own, {}), cost])
    return table(["test: network", *PAIRS, "wrong of accepted", "a step"], body)


if __name__ == "__main__":
    main()

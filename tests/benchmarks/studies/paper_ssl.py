"""Study: the paper's own SSL training (its loss, network, inputs, augmentation, rates), as far as it went here.

    boresight prepare --fleet FLEET/fleet.toml --lake FLEET/lake
    boresight train --data FLEET/lake --out RUN --config tests/benchmarks/studies/ssl_recipes/paper_joint.toml
    python -m tests.benchmarks.studies.paper_ssl --root FLEET --runs joint=RUN "pairwise camera-lidar=RUN2" ...

FLEET is a simulated fleet with its truth folder (`ssl_fleet.py`, or one of many rigs). Frames are those of side val, of
vehicles that no run learned from; guesses are the truth moved as in training (3 deg, 0.1 m per axis), the same for all
runs. Told are the loss by samples seen, the loss at the guess and at the truth, errors of a single frame's answer at
targets 15, 25 and 40 m away beside those of its guess, how long the paper's 4,000,000 samples would take at this rate,
and what a power law through the later half of the curve says that they would bring. An extrapolation of two decades is
a direction, not a number; and as the rates fall with the budget, curves of short runs bend sooner than long ones would.
Losses of one pair and of all three differ in size: the picture shows what is left of each above the truth's.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from pipeline.geometry.targets import errors_at_targets
from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.batches.loader import load_split
from pipeline.learn.network.inputs import NetworkInputs, sensor_inputs
from pipeline.learn.train.augment import random_guess
from pipeline.learn.train.checkpoints import BEST, load_checkpoint
from pipeline.learn.train.metrics import read_metrics
from pipeline.learn.train.paper_objective import PaperFrames
from pipeline.learn.train.run_state import network_of_run
from pipeline.learn.train.settings import PAIRS_OF, AugmentConfig, TrainConfig
from pipeline.report.svg import Plot, document
from pipeline.store.partitions import Lake
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.engine import RESULTS

__all__ = ["curve_of", "drawn", "extrapolated", "left_of", "table", "with_truth"]

PAPER_SAMPLES = 4_000_000  # 20 epochs of 200,000 frames
_GUESS = AugmentConfig(
    rotation_deg=3.0, translation_m=0.1, small_share=0.0, view_deg=0.0
)  # as the recipes have it
_SEED = 977
_COLOURS = ("#3b82c4", "#e0813a", "#4c9a5b", "#8a5bb0", "#c2407a")


def main() -> None:
    """Measure every run and write table, curve and numbers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--runs", nargs="+", required=True, metavar="NAME=RUN")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--out", type=Path, default=RESULTS / "paper_ssl.json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    lake = Lake.at(args.root / "lake")
    batch = load_split(lake, "val", limit=args.frames)
    true, frames = with_truth(batch, args.root / "truth"), PaperFrames(lake)
    told = {
        name: measure(Path(run), batch, true, frames)
        for name, run in (text.split("=", 1) for text in args.runs)
    }
    about = {"commit": commit_now(), "date": time.strftime("%Y-%m-%d"), "frames": len(batch)}
    args.out.write_text(json.dumps(about | {"runs": told}, indent=1) + "\n")
    args.out.with_suffix(".svg").write_text(drawn({name: left_of(run) for name, run in told.items()}))
    text = table(about, told)
    args.out.with_suffix(".md").write_text(text + "\n")
    print(text)


def measure(run: Path, batch: TrainingBatch, true: TrainingBatch, frames: PaperFrames) -> dict[str, Any]:
    """Curve, losses and errors of a run's best weights on frames, given also with their true transforms."""
    network, state = network_of_run(run), load_checkpoint(run / BEST)
    last = load_checkpoint(run / "last.pt")
    config = TrainConfig.model_validate(state["config"])
    pairs = PAIRS_OF[config.pairs]
    guess = random_guess(true, _GUESS, torch.Generator().manual_seed(_SEED))
    start = (guess.T_camera_lidar, guess.T_camera_radar, guess.T_lidar_radar)
    with torch.no_grad():
        inputs = NetworkInputs(sensor_inputs(batch, network.config.grid), *start)
        answer = network(inputs)
        found = (answer.T_camera_lidar, answer.T_camera_radar, answer.T_lidar_radar)
        truth = (true.T_camera_lidar, true.T_camera_radar, true.T_lidar_radar)
        losses = {
            name: float(sum(t.mean() for t in frames.terms(batch, *T, pairs).values()))
            for name, T in (("guess", start), ("answer", found), ("truth", truth))
        }
    known = [pair for pair in PAIRS if pair in pairs]
    errors = {
        pair: {
            "guess": _errors(pair, start, truth),
            "answer": _errors(pair, found, truth),
            "shift_m": _shift(pair, found, truth),
        }
        for pair in known
    }
    curve = curve_of(run, config.batch_size)
    seen, fallen = (np.array(curve[name], float) for name in ("samples", "loss"))
    return {
        "pairs": config.pairs,
        "samples": int(last["step"]) * config.batch_size,
        "minutes": round(float(last["trained_s"]) / 60, 1),
        "best_step": int(state["step"]),
        "loss": losses,
        "errors": errors,
        "curve": curve,
        "extrapolated": extrapolated(seen, fallen, losses["truth"]),
    }


def curve_of(run: Path, batch_size: int) -> dict[str, list[float]]:
    """Loss on held-out frames by samples seen."""
    reports = [r for r in read_metrics(run) if "validation/alignment" in r]
    return {
        "samples": [r["step"] * batch_size for r in reports],
        "loss": [round(r["validation/alignment"], 5) for r in reports],
    }


def left_of(run: dict[str, Any]) -> dict[str, list[float]]:
    """Percent of the guess's loss above the truth's that is left, by samples seen; 100 before the first."""
    guess, truth = run["loss"]["guess"], run["loss"]["truth"]
    left = [100 * (loss - truth) / (guess - truth) for loss in run["curve"]["loss"]]
    return {"samples": [0, *run["curve"]["samples"]], "left": [100.0, *left]}


def hours_for_the_paper(run: dict[str, Any]) -> float:
    """What the paper's samples would take at the rate of this run."""
    return float(PAPER_SAMPLES / run["samples"] * run["minutes"] / 60)


def extrapolated(
    samples: Float[np.ndarray, " N"], loss: Float[np.ndarray, " N"], floor: float
) -> dict[str, float] | None:
    """Power law of the loss above the truth's through the later half of the curve; None where it does not fall.

    Returns:
        `slope` of the logarithms, `at_paper`: the loss after the paper's samples, `halved_at`: samples after which what
        is left above the truth's loss is half of what it is now.
    """
    later = (samples >= samples[-1] / 2) if len(samples) else np.zeros(0, bool)
    above = loss - floor
    if later.sum() < 3 or (above[later] <= 0).any():
        return None
    slope, constant = np.polyfit(np.log(samples[later]), np.log(above[later]), 1)
    if slope >= 0:
        return None
    return {
        "slope": round(float(slope), 4),
        "at_paper": round(floor + float(np.exp(constant + slope * np.log(PAPER_SAMPLES))), 4),
        "halved_at": float(f"{samples[-1] * 2 ** (-1 / slope):.3g}"),
    }


def with_truth(batch: TrainingBatch, folder: Path) -> TrainingBatch:
    """The frames with the true transforms in place of their priors; a study's privilege."""
    poses = []
    for vehicle, day in zip(batch.vehicle, batch.day, strict=True):
        truth = json.loads((folder / vehicle / f"{day}.json").read_text())
        poses.append([truth["T_camera_lidar"], truth["T_lidar_radar"]])
    T = torch.tensor(np.array(poses), dtype=torch.float32)
    return replace(batch, T_camera_lidar=T[:, 0], T_lidar_radar=T[:, 1])


def table(about: dict[str, Any], told: dict[str, Any]) -> str:
    """Errors before and after, and the losses, one line per run."""
    titles = " | ".join(p.replace("_", "-") for p in PAIRS)
    lines = [
        f"commit {about['commit']}; {about['date']}; {about['frames']} held-out frames of vehicles that no run saw",
        "",
        "Mean azimuth / elevation [deg] (/ range [m]) at the targets, of the guess -> of one frame's answer:",
        "",
        f"| run | samples (share of the paper's) | minutes (hours for all of them) | {titles} |",
        "|---|---|---|---|---|---|",
    ]
    for name, run in told.items():
        known = run["errors"]
        cells = [
            f"{_cell(p, known[p]['guess'])} -> {_cell(p, known[p]['answer'])}" if p in known else ""
            for p in PAIRS
        ]
        share = f"{run['samples']:,} ({run['samples'] / PAPER_SAMPLES:.2%})"
        minutes = f"{run['minutes']} ({hours_for_the_paper(run):.0f})"
        lines.append(f"| {name} | {share} | {minutes} | {' | '.join(cells)} |")
    shifts = [f"{n}: {p} {e['shift_m']}" for n, r in told.items() for p, e in r["errors"].items()]
    lines += ["", f"Mean shift of the answers, parent axes [m]: {'; '.join(shifts)}"]
    lines += ["", "Loss L_P + L_G on those frames:", ""]
    lines += [
        "| run | at the guess | answered | at the truth | of the way | extrapolated |",
        "|---" * 6 + "|",
    ]
    for name, run in told.items():
        loss = run["loss"]
        way = (loss["guess"] - loss["answer"]) / (loss["guess"] - loss["truth"])
        values = " | ".join(f"{loss[k]:.3f}" for k in ("guess", "answer", "truth"))
        lines.append(f"| {name} | {values} | {way:.0%} | {_says(run['extrapolated'])} |")
    return "\n".join(lines)


def _says(extrapolated: dict[str, float] | None) -> str:
    if extrapolated is None:
        return "the later half of the curve does not fall"
    half = f"{extrapolated['halved_at']:,.0f}"
    return f"{extrapolated['at_paper']:.3f} after the paper's samples; half of what is left after {half}"


def _errors(pair: str, T: tuple[torch.Tensor, ...], truth: tuple[torch.Tensor, ...]) -> list[float]:
    """Mean azimuth, elevation [deg] and range [m] over frames."""
    k = PAIRS.index(pair)
    both = zip(T[k].double().numpy(), truth[k].double().numpy(), strict=True)
    errors = np.array([errors_at_targets(pair, a, b) for a, b in both])
    mean = np.nanmean(np.abs(errors), axis=0)
    return [round(float(v), 4) for v in (np.degrees(mean[0]), np.degrees(mean[1]), mean[2])]


def _shift(pair: str, T: tuple[torch.Tensor, ...], truth: tuple[torch.Tensor, ...]) -> list[float]:
    """Mean over frames of how far the answer puts the second sensor from where it is [m], parent axes."""
    k = PAIRS.index(pair)
    return [round(float(v), 3) for v in (T[k] - truth[k])[:, :3, 3].mean(0)]


def _cell(pair: str, errors: list[float]) -> str:
    angles = f"{errors[0]:.2f} / {errors[1]:.2f}"
    return f"{angles} / {errors[2]:.3f}" if pair == "lidar_radar" else angles


def drawn(curves: dict[str, dict[str, list[float]]]) -> str:
    """What is left of the losses over samples, as a picture."""
    most = max([1.0, *(c["samples"][-1] for c in curves.values())])
    low = min([0.0, *(v for c in curves.values() for v in c["left"])])
    high = max([100.0, *(v for c in curves.values() for v in c["left"])])
    plot = Plot(60, 20, 560, 260, (0.0, most), (low, high + 5))
    plot.frame(
        [(float(x), f"{x:,.0f}") for x in np.linspace(0, most, 5)],
        [(float(y), f"{y:.0f} %") for y in range(0, 101, 25)],
    )
    for row, ((name, curve), colour) in enumerate(zip(curves.items(), cycle(_COLOURS))):
        points = list(zip(curve["samples"], curve["left"], strict=True))
        for a, b in pairwise(points):
            plot.line(a, b, colour, 1.5)
        plot.text(612, 36 + 16 * row, name, anchor="end", colour=colour, bold=True)
    plot.text(
        340, 316, "samples seen; loss L_P + L_G left above the truth's on held-out frames", anchor="middle"
    )
    picture = document(660, 330, plot.parts, "Learning curves of the paper's training")
    return str(picture).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" color="#222" ', 1) + "\n"


if __name__ == "__main__":
    main()

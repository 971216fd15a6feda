"""Study: what training on unlabelled logs of another car does to a network, on frames that it did not learn from.

    boresight train --data LAKE --out TUNED --config tests/benchmarks/studies/ssl_recipes/real.toml --start-from RUN
    python -m tests.benchmarks.studies.ssl_real --data LAKE --runs before=RUN after=TUNED

Held-out frames of table training, of places that no other side has, are started 2 deg / 0.1 m off the logs'
own calibration, each by a draw of its own. Alignment is the weighted sum that training descends, at the starts, at the
networks' answers and at the logs' own calibration, which nobody trained on; distances are to that calibration, itself
good to about 0.2 deg.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline.geometry.se3 import perturb_exactly
from pipeline.geometry.targets import errors_at_targets
from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.batches.loader import load_split
from pipeline.learn.network.calibration_network import CalibrationNetwork
from pipeline.learn.network.inputs import NetworkInputs, sensor_inputs
from pipeline.learn.train.frame_objective import frame_objective, weighted
from pipeline.learn.train.run_state import network_of_run
from pipeline.learn.train.settings import LossConfig
from pipeline.store.partitions import Lake
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.commits import commit_now

__all__ = ["alignment", "answers", "measured", "starts", "table"]

_START = (2.0, 0.1)  # deg, m
_PASSES = 3
_AT_ONCE = 16
SIDES = ("val", "test")  # the first chose among weights, the second has seen nothing
Poses = Mapping[str, torch.Tensor]  # by pair, frames x 4 x 4


def starts(batch: TrainingBatch, seed: int) -> Poses:
    """Wrong guesses that close the loop, one draw a frame."""
    rng = np.random.default_rng(seed)
    given = given_poses(batch)
    moved = {
        pair: np.stack([perturb_exactly(T, *_moves(), rng) for T in given[pair].double().numpy()])
        for pair in ("camera_lidar", "lidar_radar")
    }
    moved["camera_radar"] = moved["camera_lidar"] @ moved["lidar_radar"]
    return {pair: torch.tensor(moved[pair], dtype=torch.float32) for pair in PAIRS}


def _moves() -> tuple[float, float]:
    return float(np.radians(_START[0])), _START[1]


def given_poses(batch: TrainingBatch) -> Poses:
    """The logs' own calibration."""
    return {pair: getattr(batch, f"T_{pair}") for pair in PAIRS}


def answers(network: CalibrationNetwork, batch: TrainingBatch, guess: Poses) -> Poses:
    """After three passes."""
    found: dict[str, list[torch.Tensor]] = {pair: [] for pair in PAIRS}
    network.eval()
    with torch.no_grad():
        for rows in torch.arange(len(batch)).split(_AT_ONCE):
            sensors = sensor_inputs(batch.take(rows), network.config.grid)
            asked = NetworkInputs(sensors, *(guess[f"{pair}"][rows] for pair in PAIRS))
            last = network.refine(asked, _PASSES)[-1]
            for pair in PAIRS:
                found[pair].append(getattr(last, f"T_{pair}"))
    return {pair: torch.cat(parts) for pair, parts in found.items()}


def alignment(batch: TrainingBatch, at: Poses) -> float:
    """Mean of what training descends, without the pull of the prior, which would measure the way from the start."""
    weights = LossConfig(prior=0.0)
    with torch.no_grad():
        terms = frame_objective(batch).terms(*(at[pair] for pair in PAIRS), PAIRS)
        return float(weighted(terms, weights, PAIRS).mean())


def distances(at: Poses, given: Poses) -> dict[str, dict[str, list[float]]]:
    """Mean and median az [deg], el [deg], range [m] at the paper's targets."""
    out = {}
    for pair in PAIRS:
        errors = np.array(
            [
                errors_at_targets(pair, T, T0)
                for T, T0 in zip(at[pair].double().numpy(), given[pair].double().numpy(), strict=True)
            ]
        )
        errors[:, :2] = np.degrees(errors[:, :2])
        out[pair] = {
            "mean": [round(float(v), 3) for v in errors.mean(0)],
            "median": [round(float(v), 3) for v in np.median(errors, axis=0)],
        }
    return out


def measured(batch: TrainingBatch, networks: Mapping[str, CalibrationNetwork], seed: int) -> dict[str, Any]:
    """Frames, and for each set of poses its alignment and its distance to the logs' own calibration."""
    guess, given = starts(batch, seed), given_poses(batch)
    poses = {"start": guess}
    poses |= {name: answers(network, batch, guess) for name, network in networks.items()}
    poses["the logs' own"] = given
    rows = {
        name: {"alignment": round(alignment(batch, at), 3), "distance": distances(at, given)}
        for name, at in poses.items()
    }
    return {"frames": len(batch), "rows": rows}


def table(side: str, told: dict[str, Any]) -> str:
    """Markdown: a row for the starts, for each network and for the logs' own calibration."""
    what = "Alignment and distance to the logs' own calibration, az / el [deg] / range [m]"
    lines = [
        f"{what}, mean (median) of {told['frames']} held-out frames (side {side}):",
        "",
        f"| poses | alignment | {' | '.join(PAIRS)} |",
        f"|---|---|{'---|' * len(PAIRS)}",
    ]
    for name, row in told["rows"].items():
        cells = [
            "{} ({})".format(
                *(" / ".join(f"{v:.2f}" for v in row["distance"][p][k]) for k in ("mean", "median"))
            )
            for p in PAIRS
        ]
        lines.append(f"| {name} | {row['alignment']:.3f} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="lake with table training of real logs")
    parser.add_argument("--runs", nargs="+", required=True, metavar="NAME=RUN")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("tests/benchmarks/results/ssl_real.json"))
    args = parser.parse_args()
    networks = {name: network_of_run(Path(run)) for name, run in (text.split("=", 1) for text in args.runs)}
    sides = {side: measured(load_split(Lake.at(args.data), side), networks, args.seed) for side in SIDES}
    about = {"commit": commit_now(), "date": time.strftime("%Y-%m-%d"), "seed": args.seed}
    args.out.write_text(json.dumps(about | sides, indent=1) + "\n")
    told = "\n\n".join(table(side, found) for side, found in sides.items())
    args.out.with_suffix(".md").write_text(f"commit {about['commit']}; {about['date']}\n\n{told}\n")
    print(told)


if __name__ == "__main__":
    main()

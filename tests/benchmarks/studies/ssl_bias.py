"""Study: by what a network's answers are off on all frames of a day alike, for `bias_sigma` of its card.

    python -m tests.benchmarks.studies.ssl_bias --root SSL/fleet --models matching=joint.onnx

Root mean squares over the vehicles of the training fleet that no network learned from, a day each, from Table 1's
prior; (bearing rotation, translation) as in `pipeline/learn/infer/aggregate.py`: three angles [deg], three shifts [m].
Days of Table 1 stay unseen. Pairwise networks are measured by the same command.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.geometry.se3 import inverse, log_se3
from pipeline.learn.infer.aggregate import Answers, _bearing_of_twist, _robust_regression
from pipeline.learn.infer.onnx_networks import open_networks
from pipeline.learn.infer.vehicle_day import _asked_day
from pipeline.results import silent
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from tests.benchmarks.studies.ssl_days import ModelSet, SslDay, fleet_days, open_day
from tests.benchmarks.studies.ssl_measures import STARTS

__all__ = ["biases", "shared_bias"]


def biases(models: ModelSet, day: SslDay) -> dict[str, np.ndarray]:
    """By pair: three angles [deg], three shifts [m]."""
    partition = Partition(day.where.vehicle, day.where.day)
    lake = Lake.at(day.where.folder / "lake")

    def frames(indices: Sequence[int]) -> Iterator[Frame]:
        return frames_of(lake, partition, indices)

    networks = open_networks(models.by_name, models.configured(day.fleet).learn, day.fleet.prepare)
    prior = day.prior(*STARTS["prior"], seed=day.where.seed)
    rng = np.random.default_rng([0, 7])  # as `solve_by_networks` of seed 0
    answers = _asked_day(dict.fromkeys(PAIRS, day.rows), prior, networks, frames, rng, silent)[1]
    unit = np.array([np.degrees(1.0)] * 3 + [1.0] * 3)
    return {pair: shared_bias(answers[pair], day.true_of(pair)) * unit for pair in PAIRS}


def shared_bias(answers: Answers, T_true: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
    """What `bias_sigma` should cover, measured against the truth: (bearing rotation [rad], translation [m])."""
    S = _bearing_of_twist(answers.T_centre)
    fit = _robust_regression(replace(answers, guess=answers.guess @ S.T, answer=answers.answer @ S.T))
    H = np.eye(6) - fit.coefficients[1:].T
    return np.asarray(fit.coefficients[0] - H @ S @ log_se3(T_true @ inverse(answers.T_centre)))


def main() -> None:
    """Measure and print, ready for the notes of `boresight export onnx`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of ssl_fleet.py: fleet")
    parser.add_argument("--models", type=ModelSet.parse, required=True, metavar="NAME=FILE[,..]")
    parser.add_argument("--days", type=int, default=None, help="at most so many vehicle-days")
    args = parser.parse_args()
    found = [biases(args.models, open_day(where)) for where in fleet_days(args.root)[: args.days]]
    for pair in PAIRS:
        print(pair, *("[" + " ".join(f"{v:+.3f}" for v in day[pair]) + "]" for day in found), sep="\n  ")
    rms = {pair: np.sqrt(np.mean([day[pair] ** 2 for day in found], axis=0)) for pair in PAIRS}
    print(json.dumps({"bias_sigma": {pair: [round(float(v), 3) for v in rms[pair]] for pair in PAIRS}}))


if __name__ == "__main__":
    main()

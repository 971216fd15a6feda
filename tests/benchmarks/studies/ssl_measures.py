"""What one network is worth on one vehicle-day: frame by frame, and as the product's own record of the day."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.calibrate.day import calibrate_observations
from pipeline.calibrate.networks import ssl_solver
from pipeline.calibrate.records import Inputs
from pipeline.errors import SolveError
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.changes import change_between
from pipeline.geometry.targets import errors_at_targets, loop_errors
from pipeline.learn.infer.onnx_networks import OnnxNetwork, open_networks
from pipeline.learn.infer.single_frame import SingleFrameCalibrator
from pipeline.learn.sample.frame_sample import SampleRejectedError
from pipeline.stage_work import Task
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from schemas.observations import Observation
from tests.benchmarks.studies.engine import search_range, spoiled
from tests.benchmarks.studies.metrics import measure, transform_of
from tests.benchmarks.studies.ssl_days import ModelSet, SslDay

__all__ = ["ITERATIONS", "STARTS", "measure_day", "measure_frames"]

ITERATIONS = 3
# What a frame is started from: the wrong prior of Table 1, and sensors that were knocked by so much and a few cm.
STARTS: dict[str, tuple[float, float]] = {
    "prior": (2.0, 0.2),
    "abrupt 2": (2.0, 0.05),
    "abrupt 5": (5.0, 0.05),
    "abrupt 10": (10.0, 0.05),
}


def measure_frames(models: ModelSet, day: SslDay, frames: int, starts: Sequence[str]) -> dict[str, Any]:
    """Errors of single frames, each started from a prior of its own, after every pass.

    Returns, by start and pair: `prior` and `errors` (frames, or frames by pass, of az [deg], el [deg], range [m] at the
    paper's targets) and `change`, the last pass's signed error (rotation vector [rad], position [m], parent axes).
    """
    networks = open_networks(models.by_name, models.configured(day.fleet).learn, day.fleet.prepare)
    calibrators = [SingleFrameCalibrator(path) for path in models.files]
    rows, images = day.spread(frames)
    began, out, rejected = time.process_time(), {}, 0
    for start in starts:
        found: dict[str, dict[str, list[Any]]] = {p: {"prior": [], "errors": [], "change": []} for p in PAIRS}
        for k, (row, image) in enumerate(zip(rows, images, strict=True)):
            prior = day.prior(*STARTS[start], seed=1000 * day.where.seed + k)
            try:
                passes = _passes(networks, calibrators, image, row, prior)
            except SampleRejectedError:
                rejected += 1
                continue
            for pair in PAIRS:
                T_true = day.true_of(pair)
                found[pair]["prior"].append(_errors(pair, prior.of(pair), T_true))
                found[pair]["errors"].append([_errors(pair, T, T_true) for T in passes[pair]])
                found[pair]["change"].append(
                    [float(f"{v:.3g}") for v in change_between(T_true, passes[pair][-1])]
                )
        out[start] = found
    return {"cpu_s": round(time.process_time() - began, 1), "rejected": rejected, "starts": out}


def _passes(
    networks: Sequence[OnnxNetwork],
    calibrators: Sequence[SingleFrameCalibrator],
    frame: Frame,
    row: Observation,
    prior: Prior,
) -> Mapping[str, list[np.ndarray]]:
    """Each pair's transform after every pass; the frame is prepared at the prior, as the product does it."""
    passes: dict[str, list[np.ndarray]] = {}
    guess = (prior.of("camera_lidar"), prior.of("lidar_radar"), prior.of("camera_radar"))
    for network, calibrator in zip(networks, calibrators, strict=True):
        estimates = calibrator.estimate(network.sensors(frame, row, prior), *guess, ITERATIONS)
        passes |= {pair: [e.of(pair) for e in estimates] for pair in network.pairs}
    return passes


def _errors(pair: str, T: np.ndarray, T_true: np.ndarray) -> list[float]:
    azimuth, elevation, range_m = errors_at_targets(pair, T, T_true)
    return [round(float(v), 3) for v in (np.degrees(azimuth), np.degrees(elevation), range_m)]


def measure_day(
    models: ModelSet,
    day: SslDay,
    frames: int | None = None,
    *,
    iterations: int = ITERATIONS,
    polish: bool = False,
) -> dict[str, Any]:
    """The product's records of the day, from Table 1's prior, against the truth; `frames` thins the day."""
    how = ("exact", *STARTS["prior"])
    prior = day.prior(*STARTS["prior"], seed=day.where.seed)
    fleet = models.configured(day.fleet, iterations).changed(solve=search_range(how) | {"polish": polish})
    rows = spoiled(day.rows, f"few:{frames}" if frames else "")
    about = Inputs(day.partition, models.method, "study", day.where.seed, ())
    solver = ssl_solver(models.method, Task(fleet, day.lake, day.partition))
    began = time.process_time()
    try:
        records = calibrate_observations(rows, prior, fleet, about, solver=solver)
    except SolveError as err:
        return {"cpu_s": round(time.process_time() - began, 1), "refused": err.reason, "pairs": {}}
    out: dict[str, Any] = {
        "cpu_s": round(time.process_time() - began, 1),
        "pairs": {
            r.pair: measure(r, day.true_of(r.pair), prior, _offset_s(day.truth.get(f"dt_{r.pair}_s")))
            for r in records
        },
    }
    found = {r.pair: T for r in records if (T := transform_of(r)) is not None}
    if set(found) == set(PAIRS):
        azimuth, elevation, range_m = loop_errors(found)
        out["loop"] = [round(float(v), 5) for v in (np.degrees(azimuth), np.degrees(elevation), range_m)]
    return out


def _offset_s(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None

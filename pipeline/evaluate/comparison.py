"""Errors of runs against the truth, at reflectors as in the paper, and in units of sigma."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.evaluate.recording import ReflectorFiles, file_of_day
from pipeline.rig.day_prior import read_transforms
from pipeline.rig.se3 import from_quaternion, inverse, log_se3
from pipeline.rig.targets import (
    ComparedRun,
    Comparison,
    Picks,
    PickUncertainty,
    error_sigma_at_picks,
    errors_at_targets,
    errors_of_picks,
    loop_error_sigma,
    loop_errors,
)
from pipeline.store.current import targets_of
from schemas.calibrations import PAIRS, CalibrationRecord
from schemas.columns import POSE_COLUMNS

__all__ = ["compare", "compare_runs", "current_runs"]


def current_runs(records: Sequence[CalibrationRecord]) -> list[dict[str, CalibrationRecord]]:
    """Records by run; if runs differ only in code or configuration, the last one."""
    by_key: dict[tuple[str, str, str, str], dict[str, CalibrationRecord]] = {}
    for r in records:
        by_key.setdefault((r.vehicle, r.day, r.method, r.work_key), {})[r.pair] = r
    runs = {}
    for about, run in by_key.items():
        first, seed = run.get("camera_lidar"), next(iter(run.values())).seed
        start = first and (first.prior_qw, first.prior_qx, first.prior_tx_m)
        runs[*about[:3], seed, start] = run
    return list(runs.values())


def compare(
    run: Mapping[str, CalibrationRecord],
    truth: Mapping[str, Float[np.ndarray, "4 4"]] | None,
    picks: Picks | None = None,
    truth_sigma: tuple[float, float] = (0.0, 0.0),
) -> Comparison | None:
    """Errors of one run against a truth or picked reflectors; None if a pair was refused.

    Args:
        run: records with one work key, by pair.
        truth_sigma: uncertainty of the truth, per axis: rotation [rad], translation [m].
    """
    if set(run) != set(PAIRS) or any(r.qw is None for r in run.values()):
        return None
    T, priors = ({pair: _transform(run[pair], prefix) for pair in PAIRS} for prefix in ("", "prior_"))
    first = run["camera_lidar"]

    def errors(of: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        if picks is not None:
            found = {pair: errors_of_picks(pair, of[pair], picks) for pair in PAIRS}
        else:
            assert truth is not None, "give either truth or picks"
            found = {
                pair: errors_at_targets(pair, of[pair], truth[pair], targets_of(run[pair])) for pair in PAIRS
            }
        return found | {"loop": loop_errors(of, targets_of(first) if picks is None else picks.lidar_m)}

    def pick_sigmas(uncertainty: PickUncertainty | None) -> dict[str, np.ndarray]:
        if picks is None or uncertainty is None:
            return {}
        found = {pair: error_sigma_at_picks(pair, T[pair], picks, uncertainty) for pair in PAIRS}
        return found | {"loop": loop_error_sigma(T, picks, uncertainty)}

    return Comparison(
        first.method,
        first.environment,
        errors(T),
        errors(priors),
        {pair: run[pair].status for pair in PAIRS},
        np.concatenate([_normalised(run[pair], T[pair], truth[pair], truth_sigma) for pair in PAIRS])
        if truth
        else np.zeros(0),
        next(
            (
                (r.loop_rotation_rad, r.loop_translation_m)
                for r in run.values()
                if r.loop_rotation_rad is not None
            ),
            None,
        ),
        pick_sigmas(picks.spread if picks else None),
        pick_sigmas(picks.sigma if picks else None),
    )


def _transform(record: CalibrationRecord, prefix: str) -> np.ndarray:
    values = np.array([getattr(record, prefix + name) for name in POSE_COLUMNS], np.float64)
    return from_quaternion(values[:4], values[4:])


def _normalised(
    record: CalibrationRecord, T: np.ndarray, T_true: np.ndarray, truth_sigma: tuple[float, float]
) -> np.ndarray:
    if record.covariance is None or record.observable is None:
        return np.zeros(0)
    of_truth = np.repeat(np.square(truth_sigma), 3)
    z = log_se3(T @ inverse(T_true)) / np.sqrt(np.diag(record.covariance) + of_truth)
    return z[np.array(record.observable, bool)]


def compare_runs(
    records: Sequence[CalibrationRecord],
    truth: Path | None,
    files: ReflectorFiles,
    truth_sigma: tuple[float, float],
) -> tuple[list[ComparedRun], dict[str, int]]:
    """Compare every current run that has a truth; also returns the number of runs without a truth or result.

    Args:
        truth: JSON with transforms, or a folder with VEHICLE/DAY.json; None if `files` has reflectors.
        truth_sigma: uncertainty of the truth, per axis: rotation [rad], translation [m].
    """
    compared, counts = [], {"refused_runs": 0, "runs_without_truth": 0}
    for run in current_runs(records):
        first = next(iter(run.values()))
        path = file_of_day(truth, first.vehicle, first.day)
        known = None if path is None else read_transforms(path)
        file = files.of(first.vehicle, first.day)
        if known is None and file is None:
            counts["runs_without_truth"] += 1
            continue
        picks = file.picks if file else None
        comparison = compare(run, known, picks, truth_sigma)
        if comparison is None:
            counts["refused_runs"] += 1
        else:
            compared.append(ComparedRun(run, known, picks, comparison))
    return compared, counts

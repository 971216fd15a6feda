"""All runs of a lake with the truth or picked reflectors of their vehicles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.evaluate.comparison import compare, current_runs
from pipeline.evaluate.recording import ReflectorFiles
from pipeline.rig.differences import ComparedRun
from pipeline.rig.prior_file import read_transforms
from schemas.calibrations import CalibrationRecord

__all__ = ["compare_runs"]


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
        known = None if truth is None else _truth_of(truth, first)
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


def _truth_of(truth: Path, record: CalibrationRecord) -> dict[str, np.ndarray] | None:
    path = truth / record.vehicle / f"{record.day}.json" if truth.is_dir() else truth
    if truth.is_dir() and not path.exists():
        return None
    return read_transforms(path)

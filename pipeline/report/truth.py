"""True extrinsics of a simulated fleet, for the table next to the estimates. Only pages read them, no estimator."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import ConfigError
from pipeline.report.words import scaled
from pipeline.rig.se3 import change_between, change_covariance, inverse
from pipeline.store.current import prior_of, transform_of
from schemas.calibrations import DOF_NAMES, CalibrationRecord

__all__ = ["read_truth", "true_transform", "truth_rows", "truth_summary"]

# (vehicle, day) -> sensor, or base -> T_base_sensor
Truth = Mapping[tuple[str, str], Mapping[str, np.ndarray]]


def read_truth(folder: Path) -> Truth:
    """Read `<folder>/<vehicle>/<day>.json`: T_base_sensor, by sensor, as 4x4 lists.

    Raises:
        ConfigError: the folder holds no such file, or one lacks a transform.
    """
    truth = {}
    for path in sorted(folder.glob("*/*.json")):
        try:
            poses = json.loads(path.read_text())["T_base_sensor"]
            of_sensors = {name: np.array(T, dtype=float) for name, T in poses.items()}
            truth[path.parent.name, path.stem] = of_sensors | {"base": np.eye(4)}
        except (KeyError, ValueError, TypeError, AttributeError) as err:
            raise ConfigError(str(path), "", f"has no true extrinsics: {err}") from err
    if not truth:
        raise ConfigError(str(folder), "truth", "holds no <vehicle>/<day>.json")
    return truth


def true_transform(truth: Truth, record: CalibrationRecord) -> Float[np.ndarray, "4 4"] | None:
    """T_parent_child of a record's day; None if it is not known."""
    poses = truth.get((record.vehicle, record.day), {})
    if record.parent_frame not in poses or record.child_frame not in poses:
        return None
    return inverse(poses[record.parent_frame]) @ poses[record.child_frame]


def truth_rows(records: Sequence[CalibrationRecord], truth: Truth) -> list[dict[str, Any]]:
    """Estimate minus truth of each record whose truth is known: by DoF in words, and whether within three sigmas."""
    found = ((record, true_transform(truth, record)) for record in records)
    return [_row(record, T_true) for record, T_true in found if T_true is not None]


def truth_summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """Number of determined axes of accepted days with errors within three of their sigmas."""
    accepted = [r for r in rows if r["status"] == "accepted"]
    axes = [w for r in accepted for w, d in zip(r["within"], r["determined"], strict=True) if d]
    if not axes:
        return "no accepted estimate"
    return f"{sum(axes)} of {len(axes)} determined axes are within three sigmas"


def _row(record: CalibrationRecord, T_true: np.ndarray) -> dict[str, Any]:
    T, T_prior = transform_of(record), prior_of(record)
    off = None if T_prior is None else change_between(T_true, T_prior)
    row = {
        "vehicle": record.vehicle,
        "day": record.day,
        "title": f"{record.parent_frame}-{record.child_frame}",
        "status": record.status,
        "prior_error": ""
        if off is None
        else f"{np.degrees(np.linalg.norm(off[:3])):.2f} deg, {100 * np.linalg.norm(off[3:]):.1f} cm",
    }
    if T is None or record.covariance is None:
        return row | {"errors": [""] * 6, "within": [True] * 6, "determined": [False] * 6}
    error = change_between(T_true, T)
    sigma = np.sqrt(np.diag(change_covariance(T, record.covariance)))
    return row | {
        "errors": [
            f"{scaled(e, d):+.3f} ± {scaled(s, d):.3f}"
            for e, s, d in zip(error, sigma, DOF_NAMES, strict=True)
        ],
        "within": np.abs(error) <= 3 * sigma,
        "determined": record.observable or [True] * 6,
    }

"""Records of a vehicle to day estimates: what each day may say, as far as its checks allow."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipeline.audit.days import PairDays, pair_days
from pipeline.geometry.se3 import from_quaternion
from schemas.calibrations import PAIRS, CalibrationRecord

__all__ = ["days_of", "fault_of", "transforms_of"]

_ROUNDING = 1e-3  # of what should be 1


def days_of(records: Sequence[CalibrationRecord], held_sigma_factor: float) -> dict[str, PairDays]:
    """Estimates by pair; refused and disproved days are gaps, held ones are less sure.

    Args:
        records: current ones of one vehicle and method, in order of day, none with a fault.
        held_sigma_factor: by which a held day is less sure at least.
    """
    pairs = {}
    for pair in PAIRS:
        rows = [r for r in records if r.pair == pair and _may_be_right(r)]
        if not rows:
            continue
        covariance = np.stack([np.asarray(r.covariance, float) for r in rows])
        common = np.stack([_common(r) for r in rows])
        held = np.array([r.status != "accepted" for r in rows])
        covariance[held] = common[held] + (covariance - common)[held] * held_sigma_factor**2
        for k in np.flatnonzero(held):
            covariance[k, :3, :3] += np.eye(3) * _shown_wrong_rad(rows[k]) ** 2
        pairs[pair] = pair_days(
            np.array([dt.date.fromisoformat(r.day).toordinal() for r in rows]),
            transforms_of(rows),
            covariance,
            common,
            np.array([r.observable or [True] * 6 for r in rows], dtype=bool),
            ~held,
        )
    return pairs


def fault_of(record: CalibrationRecord, latest_day: str) -> str | None:  # noqa: PLR0911 - a fault each
    """Why a record cannot be used, in words; None where it can. A refused day is no fault.

    Args:
        record: any.
        latest_day: the last day that a drive can be of.
    """
    if record.day > latest_day:
        return "is of a day that has not come yet"
    if record.status == "refused":
        return None
    pose, C = _pose(record), record.covariance
    if None in pose or C is None:
        return None if record.status == "held" else "has no pose"
    norm = sum(float(v or 0) ** 2 for v in pose)
    if not np.isfinite(norm) or abs(sum(float(v or 0) ** 2 for v in pose[:4]) - 1) > _ROUNDING:
        return "holds no rigid transform"
    if np.shape(C) != (6, 6) or not np.isfinite(C).all() or np.diag(C).min() <= 0 or not _is_positive(C):
        return "holds no covariance"
    common = record.common_covariance
    if common is not None and not (np.shape(common) == (6, 6) and np.isfinite(common).all()):
        return "holds no covariance of what all days err by alike"
    return None


def transforms_of(records: Sequence[CalibrationRecord]) -> Float[np.ndarray, "N 4 4"]:
    """T_parent_child of records that have one, all at once."""
    poses = np.array([_pose(r) for r in records], float)
    return from_quaternion(poses[:, :4], poses[:, 4:])


def _pose(record: CalibrationRecord) -> tuple[float | None, ...]:
    return record.qw, record.qx, record.qy, record.qz, record.tx_m, record.ty_m, record.tz_m


def _is_positive(C: np.ndarray) -> bool:
    """Whether no correlation is beyond 1: what a damaged covariance fails, at a fraction of what eigenvalues cost."""
    scale = 1 / np.sqrt(np.diag(C))
    return bool(np.abs(C * np.outer(scale, scale)).max() < 1 + _ROUNDING)


def _may_be_right(record: CalibrationRecord) -> bool:
    """Whether a record has a pose that no check disproved: a lost basin is 0.7 m off at a sigma of millimetres."""
    return (
        record.status != "refused"
        and record.covariance is not None
        and record.qw is not None
        and not record.diagnostics.get("disproved", 0.0)
    )


def _common(record: CalibrationRecord) -> Float[np.ndarray, "6 6"]:
    """What all days err by alike; nothing where an older release did not say: then all of it counts as varying."""
    return np.zeros((6, 6)) if record.common_covariance is None else record.common_covariance


def _shown_wrong_rad(record: CalibrationRecord) -> float:
    """The angle that the checks of a held record found it off by: held-out frames would turn it by so much."""
    shifts = [abs(record.diagnostics.get(f"holdout_{n}_shift_rad", 0.0)) for n in ("azimuth", "elevation")]
    worst = max(shifts)
    return worst if np.isfinite(worst) else 0.0

"""Calibration records of a small fleet, made by SE(3) algebra with noise of known covariance."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import groupby

import numpy as np
import pyarrow as pa

from pipeline.audit import estimates
from pipeline.audit.days import PairDays
from pipeline.audit.estimates import COLUMNS, estimates_of
from pipeline.calibrate.pose_rows import poses_of_records
from pipeline.calibrate.records import Inputs
from pipeline.rig.graph import Edge, pose_columns
from pipeline.rig.se3 import adjoint, exp_se3, from_rotation_translation, inverse
from pipeline.store.partitions import Partition
from pipeline.store.rows import to_table
from schemas.calibrations import CALIBRATIONS, FRAMES_OF_PAIR, PAIRS, CalibrationRecord
from schemas.poses import PoseRow

FIRST_DAY = dt.date(2026, 3, 1)
# Lidar axes (x forward, y left, z up) seen in the optical frame, sensors where a car has them.
T_CAMERA_LIDAR = from_rotation_translation(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.05, -0.4, -0.6])
)
T_LIDAR_RADAR = from_rotation_translation(np.eye(3), np.array([2.1, 0.1, -1.3]))
# One day's sigmas (rx ry rz [deg], tx ty tz [m]) in the axes of lidar_radar and of camera_lidar.
SIGMA = {
    "camera_lidar": np.array([0.02, 0.02, 0.02, 0.015, 0.015, 0.02]),
    "lidar_radar": np.array([0.5, 0.12, 0.05, 0.02, 0.02, 0.2]),
}
NO_MOTION = np.zeros(6)


def covariance_of(pair: str) -> np.ndarray:
    """One day's covariance with correlated roll and height."""
    sigma = SIGMA[pair].copy()
    sigma[:3] = np.radians(sigma[:3])
    correlation = np.eye(6)
    correlation[1, 5] = correlation[5, 1] = 0.5
    return correlation * np.outer(sigma, sigma)


def vehicle_records(
    vehicle: str,
    days: int,
    rng: np.random.Generator,
    *,
    motion: Callable[[int], dict[str, np.ndarray]] = lambda _day: {},
    status: Callable[[int], str] = lambda _day: "accepted",
    unobservable: tuple[int, ...] = (),
    noise: float = 1.0,
) -> list[CalibrationRecord]:
    """Records of one vehicle, camera_radar composed; `motion(day)`: each sensor's motion so far, own axes."""
    records = []
    for day in range(days):
        moved = motion(day)
        M = {s: exp_se3(moved.get(s, NO_MOTION)) for s in ("camera", "lidar", "radar")}
        T = {
            "camera_lidar": inverse(M["camera"]) @ T_CAMERA_LIDAR @ M["lidar"],
            "lidar_radar": inverse(M["lidar"]) @ T_LIDAR_RADAR @ M["radar"],
        }
        cov = {pair: covariance_of(pair) for pair in T}
        for pair, clean in T.items():
            T[pair] = exp_se3(noise * rng.multivariate_normal(np.zeros(6), cov[pair])) @ clean
        T["camera_radar"] = T["camera_lidar"] @ T["lidar_radar"]
        A = adjoint(T["camera_lidar"])
        cov["camera_radar"] = cov["camera_lidar"] + A @ cov["lidar_radar"] @ A.T
        records += [
            _record(vehicle, day, pair, T[pair], cov[pair], status(day), unobservable) for pair in PAIRS
        ]
    return records


def poses_of(records: Iterable[CalibrationRecord]) -> list[PoseRow]:
    """Poses of the sensors, as the calibrate stage writes them with the records; no error is common to all days."""
    rows = []
    of_day = groupby(
        sorted(records, key=lambda r: (r.vehicle, r.day, r.method)), lambda r: (r.vehicle, r.day, r.method)
    )
    for (vehicle, day, method), own in of_day:
        whole = [
            r if r.covariance is None or r.common_covariance is not None
            else replace(r, common_covariance=np.zeros((6, 6)))
            for r in own
        ]  # fmt: skip
        pairs = tuple(r.pair for r in whole)
        about = Inputs(Partition(vehicle, day), method, whole[0].work_key, 0, (), pairs)
        rows += poses_of_records(about, whole)
    return rows


def days_of(records: list[CalibrationRecord], held_sigma_factor: float) -> dict[Edge, PairDays]:
    """Records of one vehicle as the audit charts them."""
    table = to_table(records, CALIBRATIONS)
    for name in COLUMNS:
        if "." in name:
            known = [r.diagnostics.get(name.partition(".")[2]) for r in records]
            table = table.append_column(name, pa.array(known, pa.float64()))
    return estimates.days_of(estimates_of(table), held_sigma_factor)


def _record(
    vehicle: str, day: int, pair: str, T: np.ndarray, cov: np.ndarray, status: str,
    unobservable: tuple[int, ...],
) -> CalibrationRecord:  # fmt: skip
    parent, child = FRAMES_OF_PAIR[pair]
    prior = {"camera_lidar": T_CAMERA_LIDAR, "lidar_radar": T_LIDAR_RADAR}.get(pair)
    prior = T_CAMERA_LIDAR @ T_LIDAR_RADAR if prior is None else prior
    common = {
        "vehicle": vehicle, "day": (FIRST_DAY + dt.timedelta(days=day)).isoformat(), "method": "joint",
        "pair": pair,
        "parent_frame": parent, "child_frame": child, "status": status, "seed": 0, "frames_total": 120,
        "reason": "" if status == "accepted" else "held-out frames are no better than at the prior",
        "work_key": f"{vehicle}-{day}", "code_version": "0.1.0", "environment": "urban", "triggered": day > 1,
        "frames_used": 0 if status == "refused" else 80, "frames_rejected": {"no road users": 25, "sync": 15},
        **pose_columns(prior, "prior_"),
        "prior_covariance": np.diag([np.radians(2.0) ** 2] * 3 + [0.05**2] * 3),
        "trigger_before": {"lidar_outside_fraction": 0.04}, "trigger_after": {"lidar_outside_fraction": 0.004},
        "inputs": ["observations"],
    }  # fmt: skip
    if status == "refused":
        return CalibrationRecord(**common)
    seen = [k not in unobservable for k in range(6)]
    return CalibrationRecord(
        **common, **pose_columns(T),
        covariance=cov, observability=[0.97 if s else 0.05 for s in seen], observable=seen,
        alignment_before=0.62, alignment_after=0.41, time_offset_s=0.021, time_offset_sigma_s=0.004,
        notes=["no highway: radar roll is weak"], diagnostics={"halves_rotation_deg": 0.04},
    )  # fmt: skip

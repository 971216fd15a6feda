"""Calibration records of a rig of five sensors, made by SE(3) algebra with noise of known covariance."""

import datetime as dt

import numpy as np

from pipeline.rig.graph import edge_named, pose_columns
from pipeline.rig.se3 import exp_se3, from_rotation_translation, inverse
from schemas.calibrations import CalibrationRecord
from schemas.poses import PoseRow

FIRST_DAY = dt.date(2026, 3, 1)
EDGES = (
    edge_named("camera_lidar", "front", "top"),
    edge_named("camera_lidar", "left", "top"),
    edge_named("camera_radar", "front", "bumper"),
    edge_named("lidar_radar", "top", "bumper"),
    edge_named("lidar_radar", "top", "corner"),
)
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # R_body_camera
_LEFTWARDS = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
T_TOP = {
    "top": np.eye(4),
    "front": from_rotation_translation(_OPTICAL, np.array([0.4, 0.1, -0.3])),
    "left": from_rotation_translation(_LEFTWARDS @ _OPTICAL, np.array([0.1, 0.6, -0.4])),
    "bumper": from_rotation_translation(np.eye(3), np.array([2.1, 0.0, -1.2])),
    "corner": from_rotation_translation(_LEFTWARDS, np.array([1.8, 0.8, -1.1])),
}
# One day's sigmas [deg, m] along the parent's axes.
_SIGMAS = {
    "camera_lidar": np.array([0.02, 0.02, 0.03, 0.02, 0.02, 0.02]),
    "camera_radar": np.array([0.15, 0.06, 0.5, 0.05, 0.1, 0.05]),
    "lidar_radar": np.array([0.5, 0.15, 0.04, 0.05, 0.05, 0.1]),
    "lidar_base": np.array([0.05, 0.05, 0.1, 0.1, 0.1, 0.02]),
}


def covariance_of(edge):
    """One day's."""
    sigmas = _SIGMAS[edge.kind].copy()
    sigmas[:3] = np.radians(sigmas[:3])
    return np.diag(sigmas**2)


def T_of(edge, moved=None):
    """T_parent_child, each sensor moved in its own axes."""
    a, b = (T_TOP[s.name] @ exp_se3((moved or {}).get(s.name, np.zeros(6))) for s in edge.sensors)
    return inverse(a) @ b


def rig_records(vehicle, days, rng, *, motion=lambda _day: {}, edges=EDGES):
    """Accepted records of every edge and day; `motion(day)`: each sensor's motion so far, own axes."""
    return [
        record_of(vehicle, day, edge, exp_se3(_noise(edge, rng)) @ T_of(edge, motion(day)))
        for day in range(days)
        for edge in edges
    ]


def record_of(vehicle, day, edge, T):
    return CalibrationRecord(
        pair=edge.kind, parent_frame=edge.parent.name, child_frame=edge.child.name, seed=0, frames_total=120,
        frames_used=80, environment="urban", observability=[0.97] * 6, covariance=covariance_of(edge),
        common_covariance=0.1 * covariance_of(edge), **_about(vehicle, day, T, T_of(edge)),
    )  # fmt: skip


def _about(vehicle, day, T, T_prior):
    """Columns that records and poses have in common."""
    return {
        "vehicle": vehicle, "day": (FIRST_DAY + dt.timedelta(days=day)).isoformat(), "method": "joint",
        "status": "accepted", "reason": "", "code_version": "0.11.0", "work_key": f"{vehicle}-{day}",
        "observable": [True] * 6, "determined": ["azimuth", "elevation"],
        "prior_covariance": np.diag([np.radians(2.0) ** 2] * 3 + [0.05**2] * 3),
        **pose_columns(T), **pose_columns(T_prior, "prior_"),
    }  # fmt: skip


def _noise(edge, rng):
    return rng.multivariate_normal(np.zeros(6), covariance_of(edge))


KIND_OF = {s.name: s.kind for e in EDGES for s in e.sensors}
POSE_SIGMA = np.r_[np.radians([0.05, 0.05, 0.05]), 0.02, 0.02, 0.02]  # one day's, in the reference's axes


def pose_rows(vehicle, days, rng, *, motion=lambda _day: {}, reference="top", **columns):
    """A row per sensor of every day, all accepted; a tenth of the variance is common and left out of the errors.

    `motion(day)`: each sensor's motion so far, own axes; `columns`: of every row, or by (day, sensor) of one.
    """
    rows, of_one = [], columns.pop("of", {})
    for day in range(days):
        moved = {n: T_TOP[n] @ exp_se3(motion(day).get(n, np.zeros(6))) for n in T_TOP}
        for name, kind in KIND_OF.items():
            T = inverse(moved[reference]) @ moved[name]
            if name != reference:
                T = exp_se3(np.sqrt(0.9) * POSE_SIGMA * rng.normal(size=6)) @ T
            covariance = float(name != reference) * np.diag(POSE_SIGMA**2)
            own = _about(vehicle, day, T, inverse(T_TOP[reference]) @ T_TOP[name])
            own |= {"sensor": name, "kind": kind, "reference": reference}
            own |= {"covariance": covariance, "common_covariance": 0.1 * covariance}
            rows.append(PoseRow(**own | columns | of_one.get((day, name), {})))
    return rows

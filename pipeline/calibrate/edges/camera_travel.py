"""How a camera moves between pairs of its images, and the base over the same spans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.objective.ego_motion import EgoMotion
from schemas.observations import Observation

__all__ = ["CameraTravel", "camera_travel"]

_BESIDE_S = 0.6  # from a moment with a yaw rate; between two, they may be twice as far apart


@dataclass(frozen=True, eq=False)
class CameraTravel:
    """Motion of a camera between pairs of its images, in order of time, and of the base over the same spans.

    Args:
        turn, direction, covariance: N 3, N 3, N 6 6: as in the table `image_features`.
        driven_m: N, way of the base; NaN if unknown.
        turned_rad, turned_by_clock_radps: N, yaw of the base, and its change by a second of delay; NaN if unknown.
        span_s: N, between the images.
        stamp_ns, drive, scene: N, of the later image.
    """

    turn: np.ndarray
    direction: np.ndarray
    covariance: np.ndarray
    driven_m: np.ndarray
    turned_rad: np.ndarray
    turned_by_clock_radps: np.ndarray
    span_s: np.ndarray
    stamp_ns: np.ndarray
    drive: np.ndarray
    scene: np.ndarray


def camera_travel(rows: Sequence[Observation], ego: EgoMotion, scenes: Scenes) -> CameraTravel:
    """Pairs of images of a camera's rows that show a motion.

    Where odometry was not logged, the way and the yaw are those of `ego` at the moments around.
    """
    at = np.array([k for k, o in enumerate(rows) if o.motion_turn_rad is not None], np.int64)
    seen = [rows[k] for k in at]
    span_s = np.array([o.motion_span_s for o in seen], np.float64)
    stamp_ns = np.array([o.camera_stamp_ns for o in seen], np.int64)
    drive = np.array([o.drive for o in seen], np.int64)
    logged = np.array(  # NaN where not logged
        [(o.ego_driven_m, o.ego_turned_rad, o.ego_turned_by_clock_radps) for o in seen], np.float64
    ).reshape(-1, 3)
    by_ego = _by_ego(rows, ego, stamp_ns, span_s, drive)
    driven_m, turned, by_clock = np.where(np.isfinite(logged).all(axis=1, keepdims=True), logged, by_ego).T
    return CameraTravel(
        np.array([o.motion_turn_rad for o in seen], np.float64).reshape(-1, 3),
        np.array([o.motion_direction for o in seen], np.float64).reshape(-1, 3),
        np.array([o.motion_covariance for o in seen], np.float64).reshape(-1, 6, 6),
        driven_m, turned, by_clock, span_s, stamp_ns, drive, scenes.scene[at],
    )  # fmt: skip


def _by_ego(
    rows: Sequence[Observation], ego: EgoMotion, stamp_ns: np.ndarray, span_s: np.ndarray, drive: np.ndarray
) -> np.ndarray:
    """Way, yaw and change of the yaw rate over spans, N 3, from the motion at moments; NaN far from moments."""
    found = np.full((len(span_s), 3), np.nan)
    of_rows = np.array([o.drive for o in rows], np.int64)
    rows_ns = np.array([o.stamp_ns for o in rows], np.int64)
    for one in np.unique(drive):
        moments = np.flatnonzero((of_rows == one) & np.isfinite(ego.yaw_rate_radps))
        if not len(moments):
            continue
        here = np.flatnonzero(drive == one)
        first_ns = rows_ns[moments[0]]
        t = (rows_ns[moments] - first_ns) * 1e-9
        now = (stamp_ns[here] - first_ns) * 1e-9
        before, middle = now - span_s[here], now - span_s[here] / 2
        speed, rate = (np.interp(middle, t, v[moments]) for v in (ego.velocity_mps[:, 0], ego.yaw_rate_radps))
        ends = (np.interp(at, t, ego.yaw_rate_radps[moments]) for at in (now, before))
        is_beside = np.abs(t[:, None] - middle).min(0) < _BESIDE_S
        all_three = np.stack([speed * span_s[here], rate * span_s[here], np.subtract(*ends)], 1)
        found[here] = np.where(is_beside[:, None], all_three, np.nan)
    return found

"""Ego motion at a stamp, interpolated from logged odometry; never extrapolated."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pipeline.rig.se3 import exp_so3, from_quaternion, from_rotation_translation, log_so3

__all__ = ["EgoState", "EgoTrack"]

# Odometry comes at 10 Hz or more; across a longer gap the yaw rate cannot be interpolated.
_LONGEST_GAP_S = 0.5


@dataclass(frozen=True, eq=False)
class EgoState:
    """Motion at one stamp: forward speed, yaw rate (positive to the left), pose in the odometry frame."""

    speed_mps: float
    yaw_rate_radps: float
    T_odom_vehicle: Float[np.ndarray, "4 4"]


class EgoTrack:
    """Odometry of one vehicle-day."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []
        self._sorted: tuple[np.ndarray, np.ndarray] | None = None
        self.vehicle_frame = ""

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, stamp_ns: int, message: Any) -> bool:
        """Add a nav_msgs/Odometry; returns False for invalid values (not finite, zero quaternion)."""
        p, q = message.pose.pose.position, message.pose.pose.orientation
        twist = message.twist.twist
        numbers = (p.x, p.y, p.z, q.w, q.x, q.y, q.z, twist.linear.x, twist.angular.z)
        if not all(map(math.isfinite, numbers)) or not 0.5 < q.w**2 + q.x**2 + q.y**2 + q.z**2 < 2:
            return False
        self._rows.append((stamp_ns, *numbers))
        self._sorted = None
        self.vehicle_frame = str(message.child_frame_id).lstrip("/") or self.vehicle_frame
        return True

    def at(self, stamp_ns: int) -> EgoState | None:
        """State at a stamp between two odometry messages at most half a second apart, else None."""
        if not self._rows:
            return None
        stamps, values = self._arrays()
        i = int(np.searchsorted(stamps, stamp_ns, "right"))
        if i and stamps[i - 1] == stamp_ns:
            return _state(values[i - 1], values[i - 1], 0.0)
        if i == 0 or i == len(stamps) or stamps[i] - stamps[i - 1] > _LONGEST_GAP_S * 1e9:
            return None
        share = (stamp_ns - stamps[i - 1]) / (stamps[i] - stamps[i - 1])
        return _state(values[i - 1], values[i], float(share))

    def motion_at(
        self, stamps_ns: Int[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """Forward speed [m/s] and yaw rate [rad/s] at many stamps, NaN where `at` returns None."""
        unknown = np.full(len(stamps_ns), np.nan)
        if len(self._rows) < 2:
            return unknown, unknown
        stamps, values = self._arrays()
        i = np.clip(np.searchsorted(stamps, stamps_ns, "right"), 1, len(stamps) - 1)
        known = (stamps_ns >= stamps[0]) & (stamps_ns <= stamps[-1])
        known &= stamps[i] - stamps[i - 1] <= _LONGEST_GAP_S * 1e9
        known |= (stamps[i - 1] == stamps_ns) | (stamps[i] == stamps_ns)
        share = (stamps_ns - stamps[i - 1]) / (stamps[i] - stamps[i - 1])
        mixed = values[i - 1] + share[:, None] * (values[i] - values[i - 1])
        return np.where(known, mixed[:, 7], np.nan), np.where(known, mixed[:, 8], np.nan)

    def _arrays(self) -> tuple[np.ndarray, np.ndarray]:
        if self._sorted is None:
            stamps = np.array([r[0] for r in self._rows], np.int64)
            order = np.unique(stamps, return_index=True)[1]
            self._sorted = stamps[order], np.array([r[1:] for r in self._rows], np.float64)[order]
        return self._sorted


def _state(a: Float[np.ndarray, " 9"], b: Float[np.ndarray, " 9"], share: float) -> EgoState:
    both = np.stack([a, b])
    T_a, T_b = from_quaternion(both[:, 3:7], both[:, :3])
    R = T_a[:3, :3] @ exp_so3(share * log_so3(T_a[:3, :3].T @ T_b[:3, :3]))
    mixed = a + share * (b - a)
    return EgoState(float(mixed[7]), float(mixed[8]), from_rotation_translation(R, mixed[:3]))

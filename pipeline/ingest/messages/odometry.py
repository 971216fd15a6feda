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
        self._is_sorted = False
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
        self._is_sorted = False
        self.vehicle_frame = str(message.child_frame_id).lstrip("/") or self.vehicle_frame
        return True

    def at(self, stamp_ns: int) -> EgoState | None:
        """State at a stamp between two odometry messages at most half a second apart, else None."""
        if not self._rows:
            return None
        before, after, share, known = self._between(np.array([stamp_ns], np.int64))
        if not known[0]:
            return None
        both = self._values[[before[0], after[0]]]
        T_a, T_b = from_quaternion(both[:, 3:7], both[:, :3])
        R = T_a[:3, :3] @ exp_so3(share[0] * log_so3(T_a[:3, :3].T @ T_b[:3, :3]))
        mixed = both[0] + share[0] * (both[1] - both[0])
        return EgoState(float(mixed[7]), float(mixed[8]), from_rotation_translation(R, mixed[:3]))

    def motion_at(
        self, stamps_ns: Int[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """Forward speed [m/s] and yaw rate [rad/s] at many stamps, NaN where `at` returns None."""
        if not self._rows:
            return np.full(len(stamps_ns), np.nan), np.full(len(stamps_ns), np.nan)
        before, after, share, known = self._between(stamps_ns)
        a, b = self._values[before, 7:9], self._values[after, 7:9]
        speed, yaw_rate = np.where(known, (a + share[:, None] * (b - a)).T, np.nan)
        return speed, yaw_rate

    def _between(self, stamps_ns: Int[np.ndarray, " N"]) -> tuple[np.ndarray, ...]:
        """Indices of the messages before and after each stamp, its share of the gap, and whether it is known."""
        if not self._is_sorted:
            stamps = np.array([r[0] for r in self._rows], np.int64)
            order = np.unique(stamps, return_index=True)[1]
            self._stamps = stamps[order]
            self._values = np.array([r[1:] for r in self._rows], np.float64)[order]
            self._is_sorted = True
        stamps = self._stamps
        after = np.minimum(np.searchsorted(stamps, stamps_ns), len(stamps) - 1)
        before = np.where(stamps[after] == stamps_ns, after, np.maximum(after - 1, 0))
        gap = stamps[after] - stamps[before]
        known = (stamps_ns >= stamps[0]) & (stamps_ns <= stamps[-1]) & (gap <= _LONGEST_GAP_S * 1e9)
        return before, after, (stamps_ns - stamps[before]) / np.maximum(gap, 1), known

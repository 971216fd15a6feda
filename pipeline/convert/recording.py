"""A drive of a data set: intrinsics, sensor poses on the car, and events of each sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from pipeline.rig.cameras import Camera
from pipeline.rig.graph import Kind
from pipeline.rig.se3 import inverse, log_so3

__all__ = ["EgoMotion", "Event", "Recording", "ego_events", "image_format"]


class EgoMotion(NamedTuple):
    """Pose T_odom_base, forward speed [m/s], yaw rate [rad/s, positive to the left]."""

    T_odom_base: np.ndarray
    speed_mps: float
    yaw_rate_radps: float


class Event(NamedTuple):
    """One measurement; `load` returns JPEG or PNG bytes, columns of points by name, or an EgoMotion."""

    stamp_ns: int
    sensor: str  # name of the sensor, or ego
    load: Callable[[], Any]


@dataclass(frozen=True, eq=False)
class Recording:
    """One drive.

    Args:
        T_base: T_base_sensor of cameras (optical), lidars and radars (both x forward, y left, z up), by name.
        events: in order of their stamps; radar columns hold x, y, z, doppler (range rate, positive =
            receding).
    """

    vehicle: str
    day: str
    name: str
    kinds: Mapping[str, Kind]
    cameras: Mapping[str, Camera]
    T_base: Mapping[str, Float[np.ndarray, "4 4"]]
    events: Sequence[Event]


def ego_events(stamps_ns: Sequence[int], T_odom_base: Sequence[Float[np.ndarray, "4 4"]]) -> list[Event]:
    """Odometry from poses at increasing stamps: motion between neighbours."""
    events = []
    for k, (stamp, T) in enumerate(zip(stamps_ns, T_odom_base, strict=True)):
        before, after = max(k - 1, 0), min(k + 1, len(stamps_ns) - 1)
        dt_s = (stamps_ns[after] - stamps_ns[before]) / 1e9
        if dt_s <= 0:
            continue
        step = inverse(T_odom_base[before]) @ T_odom_base[after]
        motion = EgoMotion(T, float(step[0, 3] / dt_s), float(log_so3(step[:3, :3])[2] / dt_s))
        events.append(Event(stamp, "ego", partial(_same, motion)))
    return events


def _same(motion: EgoMotion) -> EgoMotion:
    return motion


def image_format(data: bytes) -> str:
    """'jpeg' or 'png', from the first bytes."""
    return "png" if data.startswith(b"\x89PNG") else "jpeg"

"""Sweeps of one lidar for the edges, from any table, and repeated de-skewing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from schemas.observations import Observation

__all__ = ["Sweep", "deskewed_again", "sweeps_of", "vehicle_sized"]

_VEHICLE_M = (0.7, 18.0)


@dataclass(frozen=True, eq=False)
class Sweep:
    """The uniform sample of one sweep, lidar axes, de-skewed to its stamp.

    Args:
        drive: continuous stretch of driving.
        is_ground: N, on the drivable ground.
        may_move: N, on something of a vehicle's size.
        time_s: N, when each point was measured, against the stamp; None if unknown.
    """

    stamp_ns: int
    drive: int
    xyz_m: np.ndarray
    is_ground: np.ndarray
    may_move: np.ndarray
    time_s: np.ndarray | None = None


def sweeps_of(observations: Sequence[Observation]) -> list[Sweep]:
    """One per observation; without points where the lidar is silent."""
    return [
        Sweep(
            o.stamp_ns,
            o.drive,
            o.lidar_map_xyz_m.astype(np.float64),
            o.lidar_map_is_ground.astype(bool),
            vehicle_sized(o.lidar_map_cluster, o.lidar_cluster_min_m, o.lidar_cluster_max_m),
            None if o.lidar_map_time_s is None else o.lidar_map_time_s.astype(np.float64),
        )
        for o in observations
    ]


def vehicle_sized(
    cluster: Int[np.ndarray, " N"], low_m: Float[np.ndarray, "K 3"], high_m: Float[np.ndarray, "K 3"]
) -> Bool[np.ndarray, " N"]:
    """Points of clusters as large as bicycles to lorries: neither posts nor walls and rails."""
    length_m = (high_m - low_m)[:, :2].max(1, initial=0.0)
    is_vehicle = (length_m > _VEHICLE_M[0]) & (length_m < _VEHICLE_M[1])
    return np.asarray(np.append(is_vehicle, False)[cluster])  # of no cluster: the last


def deskewed_again(
    sweeps: Sequence[Sweep], assumed_mps: Float[np.ndarray, "F 3"], velocity_mps: Float[np.ndarray, "F 3"]
) -> list[Sweep]:
    """Points moved along the lidar's velocity in place of that assumed by de-skewing (both in lidar axes).

    A mounting error of a degree lifts one side of a sweep by 5 cm on a motorway: a tenth of a degree of roll.
    Sweeps without times of points stay.
    """
    return [
        s
        if s.time_s is None or not np.isfinite(step).all()
        else replace(s, xyz_m=s.xyz_m + s.time_s[:, None] * step)
        for s, step in zip(sweeps, velocity_mps - assumed_mps, strict=True)
    ]

"""Sweeps of spinning lidars without a time per point: times from azimuths, and points moved to the stamp.

A turn takes a tenth of a second, in which a car drives one to three metres. fleet.toml says how the lidar turns.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, UInt16

from pipeline.core.rigs import LidarTurn
from pipeline.perceive.sweep_pairs import Arc, motions, surfaces_of
from pipeline.rig.scan_rows import rows_of
from pipeline.rig.spherical import to_spherical
from schemas.captures import Sweep

__all__ = ["BY_AZIMUTH", "WITHOUT_TIMES", "Turning", "turning_of"]

# Among the manifest's kept: sweeps that have their times from the azimuth; and those of a spinning lidar that drives,
# for which fleet.toml has no `turn`. They are left as they were logged.
BY_AZIMUTH: Final = "frames_timed_by_azimuth"
WITHOUT_TIMES: Final = "frames_without_point_times"
_NEIGHBOUR_S = 0.9  # sweeps further apart share too little
_FULL_TURN: Final = 330 / 360  # of its degrees with points, for a lidar that spins
_MOVES_MPS: Final = 0.3
_STANDS_RADPS: Final = 0.01
_OF_STAMP: Final = {"begin": 0.0, "middle": 0.5, "end": 1.0}


@runtime_checkable
class Seen(Protocol):
    """Data of a moment that this module uses."""

    @property
    def moment(self) -> int: ...
    @property
    def drive(self) -> int: ...
    @property
    def stamp_ns(self) -> int: ...
    @property
    def ego_speed_mps(self) -> float | None: ...
    @property
    def ego_yaw_rate_radps(self) -> float | None: ...


@dataclass(frozen=True, eq=False)
class Turning:
    """A lidar's rotation, None if unknown; and its motion per second in its own axes, by moment."""

    turn: LidarTurn | None
    motion: Mapping[int, Arc]

    def timed(self, seen: Seen, sweep: Sweep) -> tuple[Sweep, str]:
        """The sweep with times, moved to its stamp if its motion is known, and the counts for the manifest.

        The motion is the odometry's, or else that between sweeps. Without both, a radar's Doppler may move it later.
        """
        motion = _told(seen) or self.motion.get(seen.moment)
        stands = motion is not None and motion.way < _MOVES_MPS and abs(motion.yaw_rad) < _STANDS_RADPS
        if self.turn is None:
            return sweep, "" if stands else WITHOUT_TIMES
        time_s = _times_of(self.turn, sweep.lidar_xyz_m)
        if motion is None:
            return replace(sweep, lidar_time_s=time_s), BY_AZIMUTH
        timed = replace(sweep, lidar_time_s=time_s, lidar_deskewed=True)
        if stands:
            return timed, BY_AZIMUTH
        xyz = sweep.lidar_xyz_m.astype(np.float64)
        x, y, z = (xyz + time_s[:, None] * _velocity_of(xyz, motion)).astype(np.float32).T
        # Moved points lie in no order and at no common elevation: rows are those that were measured.
        moved = replace(timed, lidar_x_m=x, lidar_y_m=y, lidar_z_m=z, lidar_ring=_rows_of(sweep))
        return moved, BY_AZIMUTH


def turning_of(sweeps: Iterable[tuple[Seen, Sweep]], turn: LidarTurn | None) -> Turning | None:
    """A lidar's rotation as in fleet.toml; None if the sweeps have times, or it does not spin.

    Where odometry has no motion, pairs of sweeps give it.
    """
    surfaces, pairs = {}, []
    before: Seen | None = None
    for seen, sweep in sweeps:
        if before is None and (sweep.lidar_deskewed or sweep.lidar_time_s is not None or not _spins(sweep)):
            return None
        if turn is None:
            return Turning(None, {})
        if _told(seen) is None:
            surfaces[seen.moment] = surfaces_of(sweep.lidar_xyz_m)
        if (
            before is not None
            and before.drive == seen.drive
            and surfaces.keys() >= {before.moment, seen.moment}
        ):
            gap_s = (seen.stamp_ns - before.stamp_ns) * 1e-9
            pairs += [(before.moment, seen.moment, gap_s)] if 0 < gap_s < _NEIGHBOUR_S else []
        before = seen
    return Turning(turn, motions(surfaces, pairs))


def _times_of(turn: LidarTurn, xyz_m: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, " N"]:
    """Times of points relative to the stamp [s]. The azimuth grows to the left, seen from above."""
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0]).astype(np.float64) - np.radians(turn.begins_deg)
    share = (azimuth if turn.sense == "left" else -azimuth) % (2 * np.pi) / (2 * np.pi)
    return ((share - _OF_STAMP[turn.stamp]) * turn.period_s).astype(np.float32)


def _velocity_of(xyz_m: Float[np.ndarray, "N 3"], motion: Arc) -> Float[np.ndarray, "N 3"]:
    """Velocity of standing points relative to the lidar; with it, points are moved by their time to the stamp."""
    x = motion.x - motion.yaw_rad * xyz_m[:, 1]
    return np.stack([x, motion.yaw_rad * xyz_m[:, 0], np.zeros(len(xyz_m))], axis=1)


def _told(seen: Seen) -> Arc | None:
    """The odometry's motion; lidars are assumed to look ahead."""
    if seen.ego_speed_mps is None:
        return None
    return Arc(seen.ego_speed_mps, 0.0, seen.ego_yaw_rate_radps or 0.0)


def _spins(sweep: Sweep) -> bool:
    """Whether a sweep has rows, all around."""
    azimuth = np.arctan2(sweep.lidar_y_m, sweep.lidar_x_m)
    around = len(np.unique(np.floor(np.degrees(azimuth[np.isfinite(azimuth)]))))
    return around > 360 * _FULL_TURN and _rows_of(sweep) is not None


def _rows_of(sweep: Sweep) -> UInt16[np.ndarray, " N"] | None:
    """Rings as logged, or the row of each point; non-finite points get row 0."""
    if sweep.lidar_ring is not None:
        return sweep.lidar_ring
    xyz = sweep.lidar_xyz_m.astype(np.float64)
    finite = np.isfinite(xyz).all(axis=1)
    row, found = np.zeros(len(xyz), np.uint16), rows_of(to_spherical(xyz[finite]), None)
    if found is None:
        return None
    row[finite] = found.row
    return row

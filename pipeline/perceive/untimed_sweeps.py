"""Sweeps of spinning lidars without a time per point: times from azimuths, and points moved to the stamp."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt16

from pipeline.geometry.scan_rows import rows_of
from pipeline.geometry.spherical import to_spherical
from pipeline.perceive.beam_times import MOVES_MPS, BeamTimes, beam_times, velocity_of
from pipeline.perceive.sweep_pairs import Arc, surfaces_of
from pipeline.rigs import LidarTurn
from schemas.captures import Sweep

__all__ = ["BY_AZIMUTH", "WITHOUT_TIMES", "Turning", "turning_of"]

# Among the manifest's kept: sweeps that have their times from the azimuth; and those of a spinning lidar that drives,
# for which nothing tells how it turns. They are left as they were logged.
BY_AZIMUTH: Final = "frames_timed_by_azimuth"
WITHOUT_TIMES: Final = "frames_without_point_times"
_NEIGHBOUR_S = 0.9  # sweeps further apart share too little
_FULL_TURN: Final = 330 / 360  # of its degrees with points, for a lidar that spins
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

    turn: BeamTimes | None
    motion: Mapping[int, Arc]

    def timed(self, seen: Seen, sweep: Sweep) -> tuple[Sweep, str]:
        """The sweep with times, moved to its stamp if its motion is known, and the counts for the manifest.

        The motion is the odometry's, or else that between sweeps. Without both, a radar's Doppler may move it later.
        """
        motion = _told(seen) or self.motion.get(seen.moment)
        stands = motion is not None and motion.way < MOVES_MPS and abs(motion.yaw_rad) < _STANDS_RADPS
        if self.turn is None:
            return sweep, "" if stands else WITHOUT_TIMES
        time_s = self.turn.of(sweep.lidar_xyz_m)
        if motion is None:
            return replace(sweep, lidar_time_s=time_s), BY_AZIMUTH
        timed = replace(sweep, lidar_time_s=time_s, lidar_deskewed=True)
        if stands:
            return timed, BY_AZIMUTH
        xyz = sweep.lidar_xyz_m.astype(np.float64)
        x, y, z = (xyz + time_s[:, None] * velocity_of(xyz, motion)).astype(np.float32).T
        # Moved points lie in no order and at no common elevation: rows are those that were measured.
        moved = replace(timed, lidar_x_m=x, lidar_y_m=y, lidar_z_m=z, lidar_ring=_rows_of(sweep))
        return moved, BY_AZIMUTH


def turning_of(sweeps: Iterable[tuple[Seen, Sweep]], told: LidarTurn | None) -> Turning | None:
    """A lidar's rotation, from fleet.toml or from its sweeps; None if they have times, or it does not spin."""
    surfaces, pairs, moves = {}, [], {}
    before: Seen | None = None
    for seen, sweep in sweeps:
        if before is None and (sweep.lidar_deskewed or sweep.lidar_time_s is not None or not _spins(sweep)):
            return None
        if (motion := _told(seen)) is not None:
            moves[seen.moment] = motion
        surfaces[seen.moment] = surfaces_of(sweep.lidar_xyz_m)
        if before is not None and before.drive == seen.drive:
            gap_s = (seen.stamp_ns - before.stamp_ns) * 1e-9
            pairs += [(before.moment, seen.moment, gap_s)] if 0 < gap_s < _NEIGHBOUR_S else []
        before = seen
    found = beam_times(surfaces, pairs, moves)
    if told is None:
        return Turning(found.turn, found.motion)
    sense = 1.0 if told.sense == "left" else -1.0
    turn = BeamTimes(sense, float(np.radians(told.begins_deg)), told.period_s, _OF_STAMP[told.stamp])
    return Turning(turn, found.motion)


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

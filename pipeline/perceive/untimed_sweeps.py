"""Sweeps of spinning lidars without a time per point: times from azimuths, and points moved to the stamp.

A turn takes a tenth of a second, in which a car drives one to three metres. fleet.toml says how the lidar turns.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt16

from pipeline.core.rigs import LidarTurn
from pipeline.objective.sweep_registration import Surfaces, arc_between, one_per_cell, register
from pipeline.rig.scan_rows import rows_of
from pipeline.rig.se3 import exp_se3, log_se3, to_spherical
from schemas.captures import Sweep
from schemas.moments import Moment

__all__ = ["BY_AZIMUTH", "WITHOUT_TIMES", "Arc", "Turning", "turning_of"]

# Among the manifest's kept: sweeps that have their times from the azimuth; and those of a spinning lidar that drives,
# for which fleet.toml has no `turn`. They are left as they were logged.
BY_AZIMUTH: Final = "frames_timed_by_azimuth"
WITHOUT_TIMES: Final = "frames_without_point_times"
_NEIGHBOUR_S = 0.9  # sweeps further apart share too little
_FULL_TURN: Final = 330 / 360  # of its degrees with points, for a lidar that spins
_MOVES_MPS: Final = 0.3
_STANDS_RADPS: Final = 0.01
_VOXEL_M, _NEAREST_M, _REACH_M = 0.25, 3.0, 50.0
_ROAD: Final = 0.8  # vertical part of a road's normal
_MOST_POINTS, _MOST_SURFACES = 1800, 12_000
# Of the start of a registration: a car neither rolls, nods nor climbs between two sweeps.
_START_SIGMAS = np.array([1e-3, 1e-3, 0.1, 1.0, 1.0, 0.01])
_OF_STAMP: Final = {"begin": 0.0, "middle": 0.5, "end": 1.0}


class Arc(NamedTuple):
    """Motion of the lidar in its own axes, per second."""

    x: float
    y: float
    yaw_rad: float


@dataclass(frozen=True, eq=False)
class Turning:
    """A lidar's rotation, None if unknown; and its motion per second in its own axes, by moment."""

    turn: LidarTurn | None
    motion: Mapping[int, Arc]

    def timed(self, seen: Moment, sweep: Sweep) -> tuple[Sweep, str]:
        """The sweep with times, moved to its stamp if its motion is known, and the counts for the manifest.

        The motion is the odometry's, or else that between sweeps. Without both, a radar's Doppler may move it later.
        """
        motion = _told(seen) or self.motion.get(seen.moment)
        stands = (
            motion is not None
            and np.hypot(motion.x, motion.y) < _MOVES_MPS
            and abs(motion.yaw_rad) < _STANDS_RADPS
        )
        if self.turn is None:
            return sweep, "" if stands else WITHOUT_TIMES
        time_s = _times_of(self.turn, sweep.lidar_xyz_m)
        if motion is None:
            return replace(sweep, lidar_time_s=time_s), BY_AZIMUTH
        timed = replace(sweep, lidar_time_s=time_s, lidar_deskewed=True)
        if stands:
            return timed, BY_AZIMUTH
        # Against the lidar's motion, by the times.
        x, y = sweep.lidar_x_m.astype(np.float64), sweep.lidar_y_m.astype(np.float64)
        x_m = (x + time_s * (motion.x - motion.yaw_rad * y)).astype(np.float32)
        y_m = (y + time_s * (motion.yaw_rad * x)).astype(np.float32)
        # Moved points lie in no order and at no common elevation: rows are those that were measured.
        return replace(timed, lidar_x_m=x_m, lidar_y_m=y_m, lidar_ring=_rows_of(sweep)), BY_AZIMUTH


def turning_of(sweeps: Iterable[tuple[Moment, Sweep]], turn: LidarTurn | None) -> Turning | None:
    """A lidar's rotation as in fleet.toml; None if the sweeps have times, or it does not spin.

    Where odometry has no motion, pairs of sweeps give it.
    """
    surfaces, pairs = {}, []
    before: Moment | None = None
    for seen, sweep in sweeps:
        if before is None and (sweep.lidar_deskewed or sweep.lidar_time_s is not None or not _spins(sweep)):
            return None
        if turn is None:
            return Turning(None, {})
        if _told(seen) is None:
            surfaces[seen.moment] = _surfaces_of(sweep.lidar_xyz_m)
        if before is not None and before.drive == seen.drive and before.moment in surfaces:
            gap_s = (seen.stamp_ns - before.stamp_ns) * 1e-9
            if seen.moment in surfaces and 0 < gap_s < _NEIGHBOUR_S:
                pairs.append((before.moment, seen.moment, gap_s))
        before = seen
    return Turning(turn, _motions(surfaces, pairs))


def _surfaces_of(xyz_m: np.ndarray) -> Surfaces | None:
    """Surfaces of a sweep, its points thinned; None if it has too few."""
    far_m = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    near = np.isfinite(xyz_m).all(1) & (far_m > _NEAREST_M) & (far_m < _REACH_M)
    xyz = xyz_m[near].astype(np.float64)
    cell = np.floor(xyz / _VOXEL_M).astype(np.int64) @ [1, 1 << 12, 1 << 24]
    xyz = xyz[np.unique(cell, return_index=True)[1]]
    return Surfaces.of(xyz[:: max(1, len(xyz) // _MOST_SURFACES)])


def _motions(
    surfaces: Mapping[int, Surfaces | None], pairs: Sequence[tuple[int, int, float]]
) -> dict[int, Arc]:
    """Motion per second at each sweep of a pair (earlier, later, seconds between): the mean of its pairs.

    Sweeps that do not determine it have no motion, unless the pair before them does: then they start there.
    """
    held: dict[int, list[Arc]] = {}
    before: tuple[int, Arc] | None = None
    for i, j, gap_s in pairs:
        first, last, arc = surfaces[i], surfaces[j], None
        if first is not None and last is not None:
            own = arc_between(_standing(first), _standing(last), gap_s)
            start = None if own is None else Arc(own[0], 0.0, own[1])
            if start is None and before is not None and before[0] == i:
                start = before[1]
            arc = None if start is None else _matched(first, last, start, gap_s)
        before = None if arc is None else (j, arc)
        if arc is not None:
            for k in (i, j):
                held.setdefault(k, []).append(arc)
    return {k: Arc(*np.mean(of, axis=0)) for k, of in held.items()}


def _matched(first: Surfaces, last: Surfaces, start: Arc, gap_s: float) -> Arc | None:
    """The best motion near a start; None if hardly any point of the later sweep meets the earlier one."""
    points = last.xyz_m[_is_upright(last)]
    twist = np.array([0.0, 0.0, start.yaw_rad, start.x, start.y, 0.0]) * gap_s
    points = points[:: max(1, len(points) // _MOST_POINTS)]
    found = register(points, first, exp_se3(twist), _START_SIGMAS)
    if found is None:
        return None
    rate = log_se3(found[0]) / gap_s
    return Arc(float(rate[3]), float(rate[4]), float(rate[2]))


def _standing(surfaces: Surfaces) -> Float[np.ndarray, "N 2"]:
    return one_per_cell(surfaces.xyz_m[_is_upright(surfaces), :2])


def _is_upright(surfaces: Surfaces) -> Bool[np.ndarray, " N"]:
    return np.abs(surfaces.normal[:, 2]) < _ROAD


def _times_of(turn: LidarTurn, xyz_m: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, " N"]:
    """Times of points relative to the stamp [s]. The azimuth grows to the left, seen from above."""
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0]).astype(np.float64) - np.radians(turn.begins_deg)
    share = (azimuth if turn.sense == "left" else -azimuth) % (2 * np.pi) / (2 * np.pi)
    return ((share - _OF_STAMP[turn.stamp]) * turn.period_s).astype(np.float32)


def _told(seen: Moment) -> Arc | None:
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

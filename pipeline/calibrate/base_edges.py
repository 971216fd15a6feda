"""Edges other than pairs of camera, lidar and radar: lidar or radar to the vehicle frame, two lidars.

Their estimators take plain arrays; this module converts a day's rows to arrays, and evidence to records.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.edges.lidar_base import estimate_lidar_base
from pipeline.calibrate.edges.lidar_lidar import LidarPair, estimate_lidar_lidar
from pipeline.calibrate.edges.radar_base import Stamps, estimate_radar_base
from pipeline.calibrate.edges.sweeps import sweeps_of
from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.calibrate.verify.motion_sources import compared_sources
from pipeline.core.errors import SolveError
from pipeline.objective.ego_motion import (
    DopplerMotion,
    EgoMotion,
    Odometry,
    backwards,
    ego_motion,
    motion_of,
)
from pipeline.objective.radar.travel import TravelDirections, travel_directions
from pipeline.rig.checks import FailedCheck
from pipeline.rig.day_prior import no_prior
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.graph import BASE, Edge
from pipeline.rig.prior import RigPrior
from pipeline.rig.se3 import inverse
from pipeline.store.views import Chosen
from schemas.observations import Observation

__all__ = ["BaseEdges"]

_ODOMETRY = "odometry"
_FEWEST_DIRECTIONS = 8  # scans whose elevations a lidar mends: fewer show no pitch


@dataclass(frozen=True)
class BaseEdges:
    """Solves edges to the vehicle frame on one day.

    Args:
        road_z_m: where the road lies in axes of the base.
        heights: of lidars over the road by name, as somebody measured them, with sigmas [m].
    """

    prior: RigPrior
    lidars: tuple[str, ...]
    radars: tuple[str, ...]
    rows: Callable[[Chosen], list[Observation]]
    road_z_m: float = 0.0
    heights: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def solve(self, edge: Edge) -> tuple[EdgeEvidence, int]:
        """Evidence of an edge, and its number of frames; raises SolveError if there are too few."""
        if edge.kind == "lidar_base":
            return self._lidar_base(edge)
        if edge.kind == "lidar_lidar":
            return self._lidar_lidar(edge)
        assert edge.kind == "radar_base", f"{edge.kind} is estimated as a pair"
        return self._radar_base(edge)

    def _lidar_base(self, edge: Edge) -> tuple[EdgeEvidence, int]:
        rows = self._sweeps(edge.parent.name)
        scenes = Scenes.of(rows)
        T = self._on_base(edge.parent.name)
        found = estimate_lidar_base(
            edge,
            sweeps_of(rows),
            self._ego_at(rows),
            T,
            scenes,
            road_z_m=self.road_z_m,
            height_m=self.heights.get(edge.parent.name),
        )
        return found, len(rows)

    def _lidar_lidar(self, edge: Edge) -> tuple[EdgeEvidence, int]:
        parents = self._sweeps(edge.parent.name)
        of_child = {o.frame_index: o for o in self._sweeps(edge.child.name)}
        rows = [o for o in parents if o.frame_index in of_child]
        T = self._on_base(edge.parent.name), self._on_base(edge.child.name)
        pair = LidarPair(
            sweeps_of(rows),
            sweeps_of([of_child[o.frame_index] for o in rows]),
            T[0],
            T,
            self.prior.sigmas_between(edge.parent.name, BASE.name)[0],
        )
        scenes = Scenes.of(rows)
        found = estimate_lidar_lidar(edge, pair, self._ego_at(rows), inverse(T[0]) @ T[1], scenes)
        return found, len(rows)

    def _radar_base(self, edge: Edge) -> tuple[EdgeEvidence, int]:
        name = edge.parent.name
        rows = self.rows({"radar": name})
        self._on_base(name)
        radar = self._doppler(name, rows) if rows else None
        if radar is None:
            raise SolveError(f"{name} is silent: the day has no scan of it", "silent_sensor")
        if name in self._backwards:
            return _turned_round(edge, radar), len(rows)
        scenes = Scenes.of(rows)
        stamps = Stamps(*(np.array(column) for column in zip(*_stamps(rows), strict=True)))
        ego = self._ego_at(rows, without=name)
        if not np.isfinite(ego.velocity_mps).any():
            wrong = f": the car drives backwards by {', '.join(self._backwards)}" if self._backwards else ""
            raise SolveError(f"nothing but {name} itself shows how the car moves{wrong}")
        found = estimate_radar_base(edge, radar, ego, stamps, scenes, self._directions(name, rows))
        sources = compared_sources(rows, radar.T_base_radar)
        return replace(found, checks=(*found.checks, *sources.wrong)), len(rows)

    def _directions(self, radar: str, rows: Sequence[Observation]) -> TravelDirections | None:
        """Velocities that a lidar's elevations mend, of the lidar that most scans share their view with."""
        place = {o.frame_index: k for k, o in enumerate(rows)}
        found: list[TravelDirections] = []
        for lidar in self.lidars:
            T = self.prior.between(lidar, radar)
            both = [] if T is None else self.rows({"lidar": lidar, "radar": radar})
            both = [o for o in both if o.frame_index in place]
            if T is not None and both:
                seen = travel_directions(both, T, 0.0)
                at = np.array([place[both[k].frame_index] for k in seen.frame], np.int64)
                found.append(replace(seen, frame=at))
        best = max(found, key=lambda seen: seen.count, default=None)
        return None if best is None or best.count < _FEWEST_DIRECTIONS else best

    def _sweeps(self, lidar: str) -> list[Observation]:
        rows = self.rows({"lidar": lidar})
        if not rows:
            raise SolveError(f"{lidar} is silent: the day has no sweep of it", "silent_sensor")
        return rows

    def _on_base(self, name: str) -> Float[np.ndarray, "4 4"]:
        T = self.prior.between(BASE.name, name)
        if T is None:
            raise SolveError(no_prior(f"{BASE.name} and {name}"))
        return T

    @cached_property
    def _dopplers(self) -> dict[str, dict[int, Observation]]:
        """Scans of each radar by moment."""
        return {name: {o.frame_index: o for o in self.rows({"radar": name})} for name in self.radars}

    def _ego_at(self, rows: Sequence[Observation], without: str = "") -> EgoMotion:
        """Motion of the base at the rows' moments, by odometry and all radars but one."""
        radars = [name for name in self.radars if name not in (without, *self._backwards)]
        measured = [m for name in radars if (m := self._doppler(name, rows)) is not None]
        odometry = _odometry(rows)
        if _ODOMETRY in self._backwards:
            odometry = Odometry(odometry.speed_mps * np.nan, odometry.yaw_rate_radps * np.nan)
        return ego_motion(measured, odometry, heading=(0.0, 0.0))

    @cached_property
    def _backwards(self) -> list[str]:
        """Sources of motion by which the car drives backwards, where others show that it does not."""
        rows = {name: list(self._dopplers[name].values()) for name in self.radars}
        measured = [m for name in self.radars if (m := self._doppler(name, rows[name])) is not None]
        odometry = [_odometry(of_radar).speed_mps for of_radar in rows.values() if of_radar]
        speeds = {m.name: m.level()[0][:, 0] for m in measured}
        return backwards(speeds | {_ODOMETRY: np.concatenate(odometry)} if odometry else speeds)

    def _doppler(self, name: str, rows: Sequence[Observation]) -> DopplerMotion | None:
        T_base_radar = self.prior.between(BASE.name, name)
        if T_base_radar is None:
            return None
        scans = self._dopplers[name]
        nothing = np.full(3, np.nan)
        velocity, covariance = [], []
        for row in rows:
            scan = scans.get(row.frame_index)
            known = scan is not None and scan.radar_velocity_mps is not None
            velocity.append(scan.radar_velocity_mps if scan is not None and known else nothing)
            covariance.append(scan.radar_velocity_cov if scan is not None and known else np.eye(3))
        sigma_rad = self.prior.sigmas_between(BASE.name, name)[0]
        return DopplerMotion(
            name,
            np.array(velocity, np.float64).reshape(-1, 3),
            np.array(covariance, np.float64).reshape(-1, 3, 3),
            T_base_radar,
            sigma_rad,
        )


def _turned_round(edge: Edge, radar: DopplerMotion) -> EdgeEvidence:
    """A radar by whose Doppler the car drives backwards, at its prior."""
    shown = f"by the Doppler of {radar.name} the car drives backwards, by other sources it does not"
    fits = "the other sign fits (doppler_positive in fleet.toml), or its transform is turned round"
    nothing, moments = np.zeros((7, 7)), int(np.isfinite(radar.velocity_mps).all(1).sum())
    return EdgeEvidence(
        edge, inverse(radar.T_base_radar), 0.0, nothing, nothing[0], frames_used=moments,
        checks=(FailedCheck(f"{shown}: {fits}", "doppler"),),
    )  # fmt: skip


def _stamps(rows: Sequence[Observation]) -> list[tuple[int, int, int]]:
    """Of each row: the moment, the scan, the drive."""
    return [(o.stamp_ns, o.radar_stamp_ns, o.drive) for o in rows]


def _odometry(rows: Sequence[Observation]) -> Odometry:
    _, odometry = motion_of(rows, np.eye(4), 1.0)
    return odometry

"""Edges that are no pair of camera, lidar and radar: a lidar or radar on the vehicle frame, two lidars.

Their estimators take plain arrays; this is where a day's rows become those, and evidence a record.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.edges.lidar_base import Scenes, estimate_lidar_base
from pipeline.calibrate.edges.lidar_lidar import LidarPair, estimate_lidar_lidar
from pipeline.calibrate.edges.sweeps import sweeps_of
from pipeline.calibrate.numerics.frame_blocks import blocks_of, scenes_of
from pipeline.errors import SolveError
from pipeline.extrinsics.prior import no_prior
from pipeline.geometry.se3 import inverse
from pipeline.objective.ego_motion import DopplerMotion, EgoMotion, Odometry, ego_motion, motion_of
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.graph import BASE, Edge
from pipeline.rig.prior import RigPrior
from pipeline.store.views import Chosen
from schemas.observations import Observation

__all__ = ["BaseEdges"]


@dataclass(frozen=True)
class BaseEdges:
    """Solves edges to the vehicle frame on one day.

    Args:
        prior: of the rig.
        radars: names of all of them.
        rows: observations of chosen sensors.
    """

    prior: RigPrior
    radars: tuple[str, ...]
    rows: Callable[[Chosen], list[Observation]]

    def solve(self, edge: Edge) -> tuple[EdgeEvidence | None, int]:
        """What the day shows of an edge, and of how many frames; None of a kind that has no estimator.

        Raises:
            SolveError: too few frames show it.
        """
        if edge.kind == "lidar_base":
            return self._lidar_base(edge)
        if edge.kind == "lidar_lidar":
            return self._lidar_lidar(edge)
        return None, 0

    def _lidar_base(self, edge: Edge) -> tuple[EdgeEvidence, int]:
        rows = self._sweeps(edge.parent.name)
        scenes = Scenes(scenes_of(rows), blocks_of(rows))
        T = self._on_base(edge.parent.name)
        return estimate_lidar_base(edge, sweeps_of(rows), self._ego_at(rows), T, scenes), len(rows)

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
        scenes = Scenes(scenes_of(rows), blocks_of(rows))
        found = estimate_lidar_lidar(edge, pair, self._ego_at(rows), inverse(T[0]) @ T[1], scenes)
        return found, len(rows)

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

    def _ego_at(self, rows: Sequence[Observation]) -> EgoMotion:
        """Motion of the base at the rows' moments, by all radars and odometry."""
        measured = [self._doppler(name, rows) for name in self.radars]
        return ego_motion([m for m in measured if m is not None], _odometry(rows), heading=(0.0, 0.0))

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


def _odometry(rows: Sequence[Observation]) -> Odometry:
    _, odometry = motion_of(rows, np.eye(4), 1.0)
    return odometry

"""What a day shows of the car to the edges of a rig: sweeps, and how the car moves by odometry and radars."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.reasons import because
from pipeline.core.errors import SolveError
from pipeline.objective.ego_motion import DopplerMotion, EgoMotion, Odometry, ego_motion, motion_of
from pipeline.objective.ego_motion import backwards as sources_backwards
from pipeline.rig.day_prior import no_prior
from pipeline.rig.graph import BASE
from pipeline.rig.prior import RigPrior
from pipeline.store.views import Chosen
from schemas.observations import Observation

__all__ = ["DaySources"]

_ODOMETRY = "odometry"


@dataclass(frozen=True)
class DaySources:
    """Data of a day that solvers of edges ask for (`EdgeKind.solver`).

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

    def sweeps(self, lidar: str) -> list[Observation]:
        """Moments of a lidar; raises SolveError if it is silent."""
        rows = self.rows({"lidar": lidar})
        if not rows:
            raise SolveError(because("silent", sensor=lidar, what="sweep"), "silent_sensor")
        return rows

    def on_base(self, name: str) -> Float[np.ndarray, "4 4"]:
        """T_base_sensor before the day; raises SolveError if it is unknown."""
        T = self.prior.between(BASE.name, name)
        if T is None:
            raise SolveError(no_prior(f"{BASE.name} and {name}"))
        return T

    @cached_property
    def dopplers(self) -> dict[str, dict[int, Observation]]:
        """Scans of each radar by moment."""
        return {name: {o.frame_index: o for o in self.rows({"radar": name})} for name in self.radars}

    def ego_at(self, rows: Sequence[Observation], without: str = "") -> EgoMotion:
        """Motion of the base at the rows' moments, by odometry and all radars but one."""
        radars = [name for name in self.radars if name not in (without, *self.backwards)]
        measured = [m for name in radars if (m := self.doppler(name, rows)) is not None]
        odometry = _odometry(rows)
        if _ODOMETRY in self.backwards:
            odometry = Odometry(odometry.speed_mps * np.nan, odometry.yaw_rate_radps * np.nan)
        return ego_motion(measured, odometry, heading=(0.0, 0.0))

    def odometry_mps(self, rows: Sequence[Observation]) -> Float[np.ndarray, " F"] | None:
        """Speed of the base at the rows' moments by odometry alone; None where none is logged, or it is backwards."""
        speed_mps = _odometry(rows).speed_mps
        return speed_mps if np.isfinite(speed_mps).any() and _ODOMETRY not in self.backwards else None

    def ego_by_cameras(self, radar: DopplerMotion, rows: Sequence[Observation]) -> EgoMotion:
        """Motion of the base at the rows' moments: turns by cameras, the radar's own speed, which shows no clock."""
        turns: dict[int, list[float]] = {}
        for name in (node.name for node in self.prior.nodes if node.kind == "camera"):
            z = self.on_base(name)[2, :3]
            for o in self.rows({"camera": name}):
                if o.motion_turn_rad is not None and o.motion_span_s is not None:
                    turns.setdefault(o.frame_index, []).append(float(z @ o.motion_turn_rad) / o.motion_span_s)
        yaw_rate = np.array([np.mean(turns.get(o.frame_index, [np.nan])) for o in rows])
        ahead, aside = radar.level()[0].T
        speed = np.where(np.isfinite(yaw_rate), np.copysign(np.hypot(ahead, aside), ahead), np.nan)
        return EgoMotion(np.stack([speed, 0.0 * speed], 1), yaw_rate, np.zeros((len(rows), 3, 3)))

    @cached_property
    def backwards(self) -> list[str]:
        """Sources of motion by which the car drives backwards, where others show that it does not."""
        rows = {name: list(self.dopplers[name].values()) for name in self.radars}
        measured = [m for name in self.radars if (m := self.doppler(name, rows[name])) is not None]
        odometry = [_odometry(of_radar).speed_mps for of_radar in rows.values() if of_radar]
        speeds = {m.name: m.level()[0][:, 0] for m in measured}
        return sources_backwards(speeds | {_ODOMETRY: np.concatenate(odometry)} if odometry else speeds)

    def doppler(self, name: str, rows: Sequence[Observation]) -> DopplerMotion | None:
        """A radar's velocities at the rows' moments; None if its pose on the vehicle is unknown."""
        T_base_radar = self.prior.between(BASE.name, name)
        if T_base_radar is None:
            return None
        scans = (self.dopplers[name].get(row.frame_index) for row in rows)
        known = [scan if scan is not None and scan.radar_velocity_mps is not None else None for scan in scans]
        velocity = [np.full(3, np.nan) if scan is None else scan.radar_velocity_mps for scan in known]
        covariance = [np.eye(3) if scan is None else scan.radar_velocity_cov for scan in known]
        return DopplerMotion(
            name, np.array(velocity, np.float64).reshape(-1, 3), np.array(covariance, np.float64).reshape(-1, 3, 3),
            T_base_radar, self.prior.sigmas_between(BASE.name, name)[0],
        )  # fmt: skip


def _odometry(rows: Sequence[Observation]) -> Odometry:
    _, odometry = motion_of(rows, np.eye(4), 1.0)
    return odometry

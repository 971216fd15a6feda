"""Unknowns of lidar-radar, the constant inputs of the solution, and the equations at one state.

The unknowns are about the radar itself: a rotation R <- exp(r) R and a shift t <- t + s along the lidar's
axes, as in the record. A rotation about the lidar's origin would move the radar by its lever arm, and pass an
error of pitch on to z.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.lidar_radar.elevation_errors import ElevationSpread, SeenLow
from pipeline.core.config import TERMS
from pipeline.objective.radar.heights import Heights
from pipeline.objective.radar.moving_clusters import MovingClusters
from pipeline.objective.radar.registration import NormalEquations, RegistrationFrames
from pipeline.objective.radar.travel import TravelDirections
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation, log_so3
from schemas.observations import Observation

__all__ = [
    "AZIMUTH_RANGE_DOF", "DT", "ELEVATION_DOF", "RANGE", "SCHEDULE", "SEEN_LOW", "STEP_LIMIT", "UNKNOWNS",
    "UNUSED", "Linear", "RadarProblem", "RadarState", "Schedule", "Sums",
]  # fmt: skip

DT, RANGE = 6, 7
# Two constants of vehicle boxes, which no term knows any more. Without them resampling would draw other numbers, and
# sigmas of records would differ from those of earlier releases by a percent.
UNUSED = slice(8, 10)
SEEN_LOW = 10
UNKNOWNS = 11
STEP_LIMIT = np.array([0.05] * 3 + [0.15] * 3 + [0.03, 0.1] + [0.05] * 2 + [0.5])
AZIMUTH_RANGE_DOF = np.array([2, 3, 4, 6, 7])
ELEVATION_DOF = np.array([0, 1, 5])


@dataclass(frozen=True, eq=False)
class RadarState:
    """The unknowns as estimated so far, and the radar's sigmas."""

    T_lidar_radar: np.ndarray  # 4 4
    dt_s: float
    range_bias_m: float
    sigma: np.ndarray  # 3: azimuth [rad], elevation [rad], range [m]
    bounce: float  # share of detections that are mirrored in the road
    seen_low: float = 0.0  # share of their height by which detections are seen too low

    def moved(self, step: Float[np.ndarray, " P"]) -> RadarState:
        """The state after a step."""
        T = self.T_lidar_radar
        return replace(
            self,
            T_lidar_radar=from_rotation_translation(exp_so3(step[:3]) @ T[:3, :3], T[:3, 3] + step[3:6]),
            dt_s=self.dt_s + float(step[DT]),
            range_bias_m=self.range_bias_m + float(step[RANGE]),
            seen_low=self.seen_low + float(step[SEEN_LOW]),
        )

    def with_fixed(self, prior: Prior, fixed: Bool[np.ndarray, " P"]) -> RadarState:
        """The state with its fixed unknowns (rotation vector from the prior, position, dt) back at the prior."""
        if not fixed.any():
            return self
        T0, T = prior.T_lidar_radar, self.T_lidar_radar
        turn = np.where(fixed[:3], 0.0, log_so3(T[:3, :3] @ T0[:3, :3].T))
        position = np.where(fixed[3:6], T0[:3, 3], T[:3, 3])
        return replace(
            self,
            T_lidar_radar=from_rotation_translation(exp_so3(turn) @ T0[:3, :3], position),
            dt_s=0.0 if fixed[DT] else self.dt_s,
        )


@dataclass(frozen=True, eq=False)
class RadarProblem:
    """All that stays the same while the state changes."""

    observations: Sequence[Observation]
    frames: RegistrationFrames
    movers: MovingClusters
    prior: Prior
    dt_sigma_s: float
    spacing_rad: float  # of the lidar's beams, vertically
    spread: ElevationSpread
    terms: Sequence[str] = TERMS  # that take part
    # Of the stamps [s], taken out of all frames' gaps: the state's dt counts from minus it, as if the clocks were off.
    constant_gap_s: float = 0.0
    travel: TravelDirections | None = None  # None until the pose is near enough to measure them
    heights: Heights | None = None  # likewise
    seen_low: SeenLow = field(default_factory=SeenLow)
    doubt_rad: Mapping[str, float] = field(default_factory=dict)  # of pitch, beyond a source's own sigma

    def of_frames(self, index: np.ndarray) -> RadarProblem:
        """The same with part of the registration's frames (and of the observations behind them)."""
        chosen = self.frames.frame[index]
        part = [self.observations[i] for i in chosen]
        frames = replace(self.frames.subset(index), frame=np.arange(len(index), dtype=np.int64))
        return replace(
            self,
            observations=part,
            frames=frames,
            movers=self.movers.of_frames(chosen),
            travel=None if self.travel is None else self.travel.of_frames(chosen),
            heights=None if self.heights is None else self.heights.of_frames(chosen),
        )


@dataclass(frozen=True, eq=False)
class Linear:
    """Normal equations per observation at one state, and what came with them."""

    H: np.ndarray  # F P P, EM's: for steps
    information: np.ndarray  # F P P, what uncertain assignment leaves of it
    g: np.ndarray  # F P, gradient of the cost
    prior_information: np.ndarray  # P P
    prior_gradient: np.ndarray  # P
    registration: NormalEquations
    mover_sigma_rad: float
    travel_scatter_rad: float  # of the frames' ways beyond their own sigmas
    # P P: scatter of the total gradient by what all frames of elevation's sources err by; of that, what all days share.
    floors: np.ndarray
    floors_alike: np.ndarray


@dataclass(eq=False)
class Sums:
    """Equations per observation while terms are added."""

    H: np.ndarray  # F P P
    information: np.ndarray  # F P P
    g: np.ndarray  # F P
    floors: np.ndarray  # P P
    of_day: np.ndarray  # P P, of the floors what is another on every day

    @classmethod
    def none(cls, frames: int) -> Sums:
        """Without any term."""
        square = (UNKNOWNS, UNKNOWNS)
        shapes = (frames, *square), (frames, *square), (frames, UNKNOWNS), square, square
        return cls(*(np.zeros(shape) for shape in shapes))


# --------------------------------------------------------------------------------------------------
# How lidar-radar is solved: scan, annealing and last steps, in one place.


@dataclass(frozen=True)
class Schedule:
    """Steps, sigmas and frames of each stage, in the order in which they run."""

    # Scan of turns about the vertical, by the cost of a few frames: enough to separate basins.
    scan_step_deg: float = 1.5
    scan_least_deg: float = 6.0  # searched at least
    scan_reach: float = 1.7  # times the search range: corners of the box
    scan_frames: int = 24
    scan_widen: tuple[float, float, float] = (
        2.0,
        3.0,
        2.0,
    )  # of the starting sigmas: azimuth, elevation, range
    stride: int = 3  # use every n-th detection in scan and annealing

    # Annealing: Newton steps with re-association, from wide sigmas to the radar's own.
    many_frames: int = 60  # from here on half of them find the basin
    widest: float = 4.0  # times the radar's sigmas
    cooling: float = 0.75  # per step
    anneal_steps: int = 14
    wide_em_share: float = 1.0  # share of EM's step in Newton's, while sigmas are wide ...
    sharp_em_share: float = 0.5  # ... and after
    # After so many steps the time offset is scanned, with so many times the starting sigmas.
    dt_scans: Mapping[int, float] = field(default_factory=lambda: MappingProxyType({4: 1.5, 8: 0.8, 11: 0.5}))
    dt_scan_step_m: float = 0.25  # of way driven ...
    dt_compare_step_m: float = 0.2  # ... and when solutions are compared at other time offsets
    # To each side, whose median a dip is measured against: 1.5 m of way, sharp sigmas reach 0.5.
    dt_dip_steps: int = 6
    least_scan_speed_mps: float = 8.0  # slower cars need no finer steps of time

    # Last steps, with all detections.
    final_steps: int = 20
    final_em_share: float = 0.15
    converged: float = 0.003  # of the step limit: 0.1 ms, 0.5 mm, 0.01 deg
    sharpen_every: int = 3  # steps between updates of the radar's sigmas, in the first half of the last steps
    sigmas_converged: float = 0.02  # relative change of the radar's sigmas


SCHEDULE = Schedule()

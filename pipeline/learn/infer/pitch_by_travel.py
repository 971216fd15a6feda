"""A second measurement of the radar's pitch, from the direction of travel, fused with a network's answer for a day.

A network's matches err equally in all frames where elevations are noisier than scenes are tall. Doppler and the road
need no match (`pipeline.objective.radar.travel`). If the two differ by more than their sigmas allow, the network's
variance is increased (Cauchy weights): its sigma comes from other vehicles, the measurement's from this day's frames.
Only the rotation about one axis changes; all other unknowns are considered parameters (Schmidt 1966).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.learn.infer.aggregate import OBSERVABLE
from pipeline.objective.radar.heights import displaced_heights
from pipeline.objective.radar.travel import (
    TravelDirections,
    pitch_equations,
    pitch_residuals,
    travel_directions,
)
from pipeline.rig.estimates import PairEstimate, Prior, Solution, common_part
from pipeline.rig.se3 import exp_so3, inverse, log_se3
from schemas.observations import Observation

__all__ = ["WayTurn", "informed_by_way", "updated_by_way", "way_turn"]

# Scatter of the measurement between frames, beyond the sigma of a scan: 0.3 to 0.6 deg on four simulated tuning days
# (3 on a log of the real car).
_FRAME_SCATTER_RAD = np.radians(0.6)
_STEPS = 12  # of the robust mean; it gains a digit in two
_ROUNDS = 30  # of re-weighting the network
_CAUCHY = 2.0  # sigmas, as for the frames of the measurement
_CONTRADICTION_SIGMAS = 2.0  # as between the sources of method `joint`
_LEAST_SHARE = 0.7  # of the axis along a degree of freedom, above which the measurement determines it


@dataclass(frozen=True, eq=False)
class WayTurn:
    """Measured rotation of the radar about one axis of the parent's frame; other axes are not measured."""

    axis: Float[np.ndarray, " 3"]  # unit vector
    turn_rad: float  # relative to the pose at which it was measured
    variance: float  # from the scatter of this day's frames, without the floor
    floor: float  # variance of the error that all frames have in common
    frames: int

    @property
    def sigma_rad(self) -> float:
        """Sigma of the rotation, floor included."""
        return float(np.sqrt(self.variance + self.floor))


def informed_by_way(solution: Solution, observations: Sequence[Observation], prior: Prior) -> Solution:
    """The solution with the radar's pitch fused with the direction of travel, in the pairs that have frames.

    Args:
        solution: solution by networks; camera_radar is updated through camera_lidar, for a day but not for
            one frame.
        observations: the frames of the solution, or others of the day.
        prior: for the observability, which compares the covariance with the prior's.
    """
    lidar_radar, camera_lidar = solution.pairs["lidar_radar"], solution.pairs["camera_lidar"]
    way = way_turn(observations, lidar_radar.T)
    if way is None:
        return solution
    through = {"lidar_radar": way}
    if way.frames > 1:
        # One frame's camera_lidar is no bridge: on five simulated days it made camera_radar of single frames worse
        # (0.24 deg before, 0.31 behind it).
        T_camera_radar = solution.pairs["camera_radar"].T
        through["camera_radar"] = _seen_by_camera(way, camera_lidar, lidar_radar.T, T_camera_radar)
    pairs = {
        pair: updated_by_way(estimate, through[pair], prior.covariance(pair))
        if pair in through and estimate.frames_used
        else estimate
        for pair, estimate in solution.pairs.items()
    }
    return replace(solution, pairs=pairs)


def way_turn(observations: Sequence[Observation], T_lidar_radar: Float[np.ndarray, "4 4"]) -> WayTurn | None:
    """Rotation measured by the direction of travel at a pose; None if too few frames determine it.

    The variance is that of the robust mean, at least that from differences between drives. A single frame has
    no scatter and gets a typical one.
    """
    travel = travel_directions(observations, T_lidar_radar, 0.0)
    if len(observations) == 1:
        return _frame_turn(travel, T_lidar_radar)
    _, J = pitch_residuals(travel, T_lidar_radar)
    mean = np.append(J[:, :2].mean(axis=0), 0.0) if len(J) else np.zeros(3)
    if not mean.any():
        return None
    # A turn about this axis, the left one of a car that drives ahead, lowers the velocity.
    axis = -mean / np.linalg.norm(mean)
    turn_rad = 0.0
    for _ in range(_STEPS):
        H, g, scatter_rad = pitch_equations(
            travel, _turned(T_lidar_radar, axis * turn_rad), len(observations)
        )
        if not np.isfinite(scatter_rad):
            return None
        information, gradient = axis[:2] @ H.sum(0) @ axis[:2], g @ axis[:2]
        turn_rad -= float(gradient.sum() / information)
    blocks = np.unique([o.drive for o in observations], return_inverse=True)[1].ravel()
    between = float(np.square(np.bincount(blocks, gradient)).sum()) / information**2
    floor = _floor(observations, _turned(T_lidar_radar, axis * turn_rad))
    return WayTurn(axis, turn_rad, max(1 / information, between), floor, travel.count)


def _floor(observations: Sequence[Observation], T_lidar_radar: Float[np.ndarray, "4 4"]) -> float:
    """Variance of the bias due to detections below the road, at the measured pose."""
    travel = travel_directions(observations, T_lidar_radar, 0.0)
    heights = displaced_heights(observations, T_lidar_radar, 0.0, np.random.default_rng(0))
    share = 0.0 if heights is None or not travel.count else heights.seen_low(travel.below)
    return travel.bias_rad(share) ** 2


def _frame_turn(travel: TravelDirections, T_lidar_radar: Float[np.ndarray, "4 4"]) -> WayTurn | None:
    if not travel.count:
        return None
    residual, J = pitch_residuals(travel, T_lidar_radar)
    axis = -np.append(J[0, :2], 0.0) / np.linalg.norm(J[0, :2])
    variance = float(travel.sigma_rad[0] ** 2) + _FRAME_SCATTER_RAD**2
    return WayTurn(axis, float(residual[0]), variance, travel.bias_rad(0.0) ** 2, 1)


def updated_by_way(
    estimate: PairEstimate, way: WayTurn, prior_covariance: Float[np.ndarray, "6 6"]
) -> PairEstimate:
    """The estimate fused with the measurement: pose rotated about the child's origin, covariance, common covariance."""
    row = np.append(way.axis, np.zeros(3))
    direction = np.append(way.axis, np.cross(estimate.T[:3, 3], way.axis))
    own, measured = float(row @ estimate.covariance @ row), way.variance + way.floor
    # In one frame the measurement is no better than the network: bumps, bridges, passing trucks.
    doubt = _doubt(way.turn_rad, own, measured) if way.frames > 1 else 0.0
    gain = (own + doubt) / (own + doubt + measured)
    step, keep = gain * direction, np.eye(6) - gain * np.outer(direction, row)

    def updated(covariance: np.ndarray, noise: float) -> np.ndarray:
        wide = covariance + doubt * np.outer(direction, direction)
        return np.asarray(keep @ wide @ keep.T + noise * np.outer(step, step))

    covariance = updated(estimate.covariance, measured)
    common = estimate.common_covariance
    observability = np.clip(1 - np.diag(covariance) / np.diag(prior_covariance), 0.0, 1.0)
    told = np.append(np.abs(way.axis) > _LEAST_SHARE, np.zeros(3, bool)) & (observability >= OBSERVABLE)
    apart = way.turn_rad / np.sqrt(own + measured)
    notes = list(estimate.notes)
    if abs(apart) > _CONTRADICTION_SIGMAS and way.frames > 1:
        differs = f"{np.degrees(way.turn_rad):+.2f} +- {np.degrees(way.sigma_rad):.2f} deg of pitch"
        notes.append(
            f"the direction of travel (Doppler, road, {way.frames} frames) differs by {differs} from the network's "
            f"answer, {abs(apart):.1f} sigmas: the network's answer has less weight"
        )
    return replace(
        estimate,
        T=_turned(estimate.T, gain * way.turn_rad * way.axis),
        covariance=covariance,
        common_covariance=None if common is None else common_part(updated(common, way.floor), covariance),
        observability=observability,
        observable=estimate.observable | told,
        diagnostics=estimate.diagnostics
        | {
            "doppler_pitch_offset_rad": way.turn_rad,
            "doppler_pitch_sigma_rad": way.sigma_rad,
            "doppler_frames": float(way.frames),
        },
        notes=notes,
    )


def _doubt(turn_rad: float, own: float, measured: float) -> float:
    """Variance to add to the network's so that its residual has the weight of a Cauchy distribution."""
    doubt = (turn_rad / _CAUCHY) ** 2
    for _ in range(_ROUNDS):
        moved = turn_rad * (own + doubt) / (own + doubt + measured)
        doubt = (moved / _CAUCHY) ** 2
    return doubt


def _seen_by_camera(
    way: WayTurn, camera_lidar: PairEstimate, T_lidar_radar: np.ndarray, T_camera_radar: np.ndarray
) -> WayTurn:
    """The measurement for camera_radar: through camera_lidar, whose variance about the axis is added."""
    axis = camera_lidar.T[:3, :3] @ way.axis
    wanted = camera_lidar.T @ _turned(T_lidar_radar, way.turn_rad * way.axis)
    turn_rad = float(axis @ log_se3(wanted @ inverse(T_camera_radar))[:3])
    own = float(axis @ camera_lidar.covariance[:3, :3] @ axis)
    return replace(way, axis=axis, turn_rad=turn_rad, variance=way.variance + own)


def _turned(T: Float[np.ndarray, "4 4"], omega: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """T rotated about the child's own origin, by a rotation vector in parent axes."""
    out = T.copy()
    out[:3, :3] = exp_so3(omega) @ T[:3, :3]
    return out

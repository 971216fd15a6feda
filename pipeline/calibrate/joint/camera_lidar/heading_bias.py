"""Bias of T_camera_lidar from a wrong heading of the car in lidar axes, which more frames do not reduce.

A sweep takes a tenth of a second; de-skewing moves its points along the car's velocity, whose direction in
lidar axes follows from the prior's mounting. A mounting error of a degree then lifts one side of the sweep
and lowers the other, in proportion to speed. On highways this is a tenth of a degree of roll, for both edges
and markings. The camera's time offset moves the cloud along the same velocity, whose heading comes from the
radar and its prior.

Source: Schmidt 1966 (parameters that are considered, not solved for).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.calibrate.numerics.bias_floors import MOUNTING_SIGMA_RAD, SWEEP_S
from pipeline.objective.camera_lidar.points import Points
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from pipeline.rig.changes import change_jacobian
from schemas.observations import Observation

__all__ = ["MotionSigmas", "motion_biases", "sweep_s_per_rad"]

_STAMP_SIGMA_S = SWEEP_S / np.sqrt(12)  # a sweep's stamp may be of its begin, middle or end


@dataclass(frozen=True)
class MotionSigmas:
    """Sigmas of the car's motion in the lidar's axes, and the duration of a sweep."""

    heading_rad: float  # one sigma of the velocities that the terms have
    s_per_rad: float  # time of a sweep per azimuth


def sweep_s_per_rad(observations: Sequence[Observation]) -> float:
    """Time [s/rad] that a sweep takes per azimuth, from the azimuths that occur."""
    cloud = np.concatenate([o.lidar_map_xyz_m[::20] for o in observations[:20]])
    if len(cloud) < 10:
        return SWEEP_S / (2 * np.pi)
    low, high = np.percentile(np.arctan2(cloud[:, 1], cloud[:, 0]), (0.5, 99.5))
    return float(SWEEP_S / max(high - low, 0.5))


def motion_biases(
    terms: Terms,
    state: AlignmentState,
    kernel: KernelSettings,
    curvature: Float[np.ndarray, "8 8"],
    fixed: Bool[np.ndarray, " 8"],
    sigmas: MotionSigmas,
) -> Float[np.ndarray, "5 8"]:
    """Change of the solution (coordinates of `changed`) by one sigma of each unknown of the motion.

    Rows: heading of the velocities; yaw and pitch of the mounting, each by azimuth and by the sweep's mean
    time. Unknowns in `fixed` stay; `sigmas` are of the heading, and a sweep's duration.
    """
    across = terms.velocity_lidar @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    up = np.linalg.norm(terms.velocity_lidar, axis=1)[:, None] * np.array([0.0, 0.0, 1.0])
    turned = replace(terms, velocity_lidar=terms.velocity_lidar + sigmas.heading_rad * across)
    skewed = [
        _skewed(terms, MOUNTING_SIGMA_RAD * along, per_rad, constant)
        for along in (across, up)
        for per_rad, constant in ((sigmas.s_per_rad, 0.0), (0.0, _STAMP_SIGMA_S))
    ]
    before = _gradient(terms, state, kernel)
    to_left = np.eye(8)
    to_left[:6, :6] = np.linalg.inv(change_jacobian(state.T_camera_lidar))
    out, free = np.zeros((5, 8)), ~fixed
    for row, other in zip(out, (turned, *skewed), strict=True):
        change = to_left.T @ (_gradient(other, state, kernel) - before)
        row[free] = np.linalg.solve(curvature[np.ix_(free, free)], change[free])
    return out


def _gradient(terms: Terms, state: AlignmentState, kernel: KernelSettings) -> Float[np.ndarray, " 8"]:
    """Gradient of the score by left perturbation, time offset, focal scale."""
    return terms.gradient(state.alone, kernel)[0].sum(0)


def _skewed(terms: Terms, velocity: Float[np.ndarray, "F 3"], s_per_rad: float, s: float) -> Terms:
    """Points moved along a velocity for a time that grows with their azimuth."""

    def moved(points: Points) -> Points:
        frame = np.repeat(np.arange(terms.frames), np.diff(points.start))
        azimuth = np.arctan2(points.xyz_m[:, 1], points.xyz_m[:, 0])
        shifted = points.xyz_m + (s + azimuth * s_per_rad)[:, None] * velocity[frame]
        return replace(points, xyz_m=np.ascontiguousarray(shifted, np.float32))

    return replace(terms, edges=moved(terms.edges), markings=moved(terms.markings))

"""What an unknown direction of travel in the lidar's axes does to T_camera_lidar: a bias that more frames do not lower.

A sweep takes a tenth of a second; de-skewing moves its points along the car's velocity, as the prior's mounting has
it. A mounting that is off by a degree then lifts one side of the sweep and lowers the other, in proportion to speed:
on highways that is a tenth of a degree of roll, in edges and markings alike. The camera's time offset moves the cloud
along the same velocity, whose heading comes from the radar and its prior.

Source: Schmidt 1966 (parameters that are considered, not solved for).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.geometry.changes import change_jacobian
from pipeline.objective.camera_lidar.points import Points
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from schemas.observations import Observation

__all__ = ["motion_biases", "sweep_s_per_rad"]

_SWEEP_S = 0.1  # rotating and scanning lidars alike run at 10 Hz
# Roll's errors on simulated days of seeds 110 to 145, most of them of this kind, were two thirds of what 1 deg says.
_MOUNT_SIGMA_RAD = np.radians(0.6)
_STAMP_SIGMA_S = _SWEEP_S / np.sqrt(12)  # a sweep's stamp may be of its begin, middle or end


def sweep_s_per_rad(observations: Sequence[Observation]) -> float:
    """Time that a sweep takes per radian of azimuth, from the azimuths that there are."""
    cloud = np.concatenate([o.lidar_map_xyz_m[::20] for o in observations[:20]])
    if len(cloud) < 10:
        return _SWEEP_S / (2 * np.pi)
    low, high = np.percentile(np.arctan2(cloud[:, 1], cloud[:, 0]), (0.5, 99.5))
    return float(_SWEEP_S / max(high - low, 0.5))


def motion_biases(
    terms: Terms,
    state: AlignmentState,
    level: KernelSettings,
    curvature: Float[np.ndarray, "8 8"],
    held: Bool[np.ndarray, " 8"],
    heading_sigma_rad: float,
    s_per_rad: float,
) -> Float[np.ndarray, "5 8"]:
    """One sigma of each unknown of the motion, as moves of the solution (chart of `changed`).

    Heading of the velocities; yaw and pitch of the mounting, once by azimuth and once by the sweep's mean time.

    Args:
        terms: points and velocities.
        state: the solution.
        level: of the gradients.
        curvature: of the cost, in the chart of `changed`.
        held: what does not follow.
        heading_sigma_rad: of the velocities that `terms` has.
        s_per_rad: time of a sweep per azimuth.
    """
    across = terms.velocity_lidar @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    up = np.linalg.norm(terms.velocity_lidar, axis=1)[:, None] * np.array([0.0, 0.0, 1.0])
    turned = replace(terms, velocity_lidar=terms.velocity_lidar + heading_sigma_rad * across)
    skewed = [
        _skewed(terms, _MOUNT_SIGMA_RAD * along, slope, constant)
        for along in (across, up)
        for slope, constant in ((s_per_rad, 0.0), (0.0, _STAMP_SIGMA_S))
    ]
    before = _slope(terms, state, level)
    to_left = np.eye(8)
    to_left[:6, :6] = np.linalg.inv(change_jacobian(state.T_camera_lidar))
    out, free = np.zeros((5, 8)), ~held
    for row, other in zip(out, (turned, *skewed), strict=True):
        change = to_left.T @ (_slope(other, state, level) - before)
        row[free] = np.linalg.solve(curvature[np.ix_(free, free)], change[free])
    return out


def _slope(terms: Terms, state: AlignmentState, level: KernelSettings) -> Float[np.ndarray, " 8"]:
    """Gradient of the score by left perturbation, time offset, focal scale."""
    return terms.gradient(state.alone, level)[0].sum(0)


def _skewed(terms: Terms, velocity: Float[np.ndarray, "F 3"], s_per_rad: float, s: float) -> Terms:
    """Points moved along a velocity for a time that grows with their azimuth."""

    def moved(points: Points) -> Points:
        frame = np.repeat(np.arange(terms.frames), np.diff(points.start))
        azimuth = np.arctan2(points.xyz_m[:, 1], points.xyz_m[:, 0])
        shifted = points.xyz_m + (s + azimuth * s_per_rad)[:, None] * velocity[frame]
        return replace(points, xyz_m=np.ascontiguousarray(shifted, np.float32))

    return replace(terms, edges=moved(terms.edges), markings=moved(terms.markings))

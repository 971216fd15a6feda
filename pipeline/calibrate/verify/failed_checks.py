"""Checks of a solution as a whole: closure of the loop, and the heading.

Each returns one value per failed check for `judge`; none if all pass.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.core.config import ChecksConfig
from pipeline.objective.stamp_gaps import camera_gaps_s, constant_gap_s
from pipeline.rig.changes import change_between
from pipeline.rig.checks import FailedCheck
from pipeline.rig.estimates import Prior, Solution
from pipeline.rig.se3 import adjoint, inverse
from pipeline.rig.targets import DEFAULT_TARGETS
from schemas.observations import Observation

__all__ = ["heading_failures", "loop_failures", "loop_sigmas"]


def loop_failures(solution: Solution, limits: ChecksConfig | None = None) -> list[FailedCheck]:
    """A loop of independent estimates that does not close within its sigma: an error of any pair, so all fail."""
    limits = limits or ChecksConfig()
    found = loop_sigmas(solution)
    if found is None or solution.loop_rotation_rad is None or solution.loop_translation_m is None:
        return []
    rotation, translation = found
    failed = []
    if solution.loop_rotation_rad > limits.max_loop_sigmas * rotation:
        open_deg, sigma_deg = np.degrees(solution.loop_rotation_rad), np.degrees(rotation)
        failed.append(f"the loop is open by {open_deg:.2f} deg, its sigma is {sigma_deg:.2f} deg")
    if solution.loop_translation_m > limits.max_loop_sigmas * translation:
        failed.append(
            f"the loop is open by {solution.loop_translation_m:.3f} m, its sigma is {translation:.3f} m"
        )
    return [FailedCheck(sentence, "witnesses_disagree") for sentence in failed]


def heading_failures(
    solution: Solution,
    prior: Prior,
    observations: Sequence[Observation],
    limit_rad: float,
    limits: ChecksConfig | None = None,
) -> list[FailedCheck]:
    """Failed check of camera-lidar if it was solved with a heading that lidar-radar contradicts.

    A camera's time offset moves the cloud along the car's heading, which the radar's prior mounting gives.
    If lidar-radar rotates the radar by many of the prior's sigmas, that heading was wrong. Camera-lidar then
    has a lateral error of time offset times speed times this rotation.

    Args:
        prior: prior whose T_lidar_radar gave the heading.
        limit_rad: largest error that camera-lidar may have at the targets.
        limits: threshold for a wrong heading, and its allowed share of `limit_rad`; None = the defaults.
    """
    limits = limits or ChecksConfig()
    if not {"camera_lidar", "lidar_radar"} <= solution.pairs.keys():
        return []
    dt_s, expected_s = (
        solution.pairs["camera_lidar"].time_offset_s,
        constant_gap_s(camera_gaps_s(observations)),
    )
    turn = abs(float(change_between(prior.T_lidar_radar, solution.pairs["lidar_radar"].T)[2]))
    speeds = [abs(o.ego_speed_mps) for o in observations if o.ego_speed_mps is not None]
    if not speeds or turn < limits.heading_change_prior_sigmas * prior.rotation_sigma_rad:
        return []
    # What lies between sweep and image on the way, where the stamps' constant gap is the clock's.
    way_s = 0.0 if dt_s is None else abs(dt_s - expected_s)
    lateral_m = turn * way_s * float(np.mean(speeds))
    rad_per_metre = float(np.sqrt(np.mean(1 / np.sum(DEFAULT_TARGETS**2, axis=1))))
    if lateral_m * rad_per_metre < limits.max_heading_error_share * limit_rad:
        return []
    off = f"assumed heading off by {np.degrees(turn):.1f} deg by lidar-radar"
    return [FailedCheck(f"{off}: up to {lateral_m:.2f} m lateral error through the camera's time offset")]


def loop_sigmas(solution: Solution) -> tuple[float, float] | None:
    """Sigma of the loop's angle [rad] and translation [m] if all three pairs were estimated independently."""
    if solution.loop_rotation_rad is None or solution.loop_translation_m is None:
        return None
    covariance = _loop_covariance(solution)
    return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.sqrt(np.trace(covariance[3:, 3:])))


def _loop_covariance(solution: Solution) -> np.ndarray:
    """Covariance (6 6) of T_camera_lidar T_lidar_radar T_radar_camera, with independent factors (first order)."""
    cl, lr, cr = (solution.pairs[p] for p in ("camera_lidar", "lidar_radar", "camera_radar"))
    A = adjoint(cl.T)
    B = adjoint(cl.T @ lr.T @ inverse(cr.T))
    return cl.covariance + A @ lr.covariance @ A.T + B @ cr.covariance @ B.T

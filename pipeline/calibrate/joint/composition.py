"""Camera-radar by the loop: composed of the other two pairs, and held against the estimate without the lidar."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.calibrate.joint.failed_checks import open_loop
from pipeline.calibrate.numerics.covariance import OBSERVABLE
from pipeline.extrinsics.checks import FailedCheck
from pipeline.extrinsics.estimates import PairEstimate, Prior
from pipeline.geometry.changes import change_covariance, change_jacobian
from pipeline.geometry.se3 import adjoint, compose_covariance, inverse, log_so3

__all__ = ["compose_pairs"]

_MOSTLY = 0.5  # of a variance: from there on it is called the prior's


def compose_pairs(
    camera_lidar: PairEstimate, lidar_radar: PairEstimate, without_lidar: PairEstimate, prior: Prior
) -> tuple[PairEstimate, float | None, list[FailedCheck]]:
    """Camera-radar by the loop, and how far the camera-radar estimate that never saw the lidar is from it.

    Returns:
        The composed estimate; the loop's angle over the rotations that `without_lidar` determined (None where it
        determined none; its translation is the prior's, so no translation is compared); sentences where that angle is
        beyond its sigma.
    """
    T = camera_lidar.T @ lidar_radar.T
    covariance = compose_covariance(camera_lidar.T, camera_lidar.covariance, lidar_radar.covariance)
    observability, observable = _composed_observability(camera_lidar, lidar_radar, prior)
    difference = log_so3((T @ inverse(without_lidar.T))[:3, :3])
    sigma = np.sqrt(np.diag(covariance)[:3] + np.diag(without_lidar.covariance)[:3])
    known = without_lidar.observable[:3]
    diagnostics = {f"alone_{k}": v for k, v in without_lidar.diagnostics.items()}
    diagnostics |= {f"alone_{n}_rad": float(d) for n, d in zip(("rx", "ry", "rz"), -difference, strict=True)}
    diagnostics |= {f"alone_{n}_sigma_rad": float(s) for n, s in zip(("rx", "ry", "rz"), sigma, strict=True)}
    if known.any():
        diagnostics["loop_rotation_sigma_rad"] = float(np.sqrt(np.sum(sigma[known] ** 2)))
    estimate = PairEstimate(
        "camera_radar",
        T,
        covariance,
        observability,
        observable,
        min(camera_lidar.frames_used, lidar_radar.frames_used),
        _either(camera_lidar.frames_rejected, lidar_radar.frames_rejected),
        *_time_offset(camera_lidar, lidar_radar),
        diagnostics,
        [
            "composed of camera-lidar and lidar-radar, their errors taken as independent",
            "loop: camera-radar without the lidar, rotations only (its translation is the prior's)",
        ],
        _composed_common(camera_lidar, lidar_radar),
    )
    loop_rad = float(np.linalg.norm(difference[known])) if known.any() else None
    return estimate, loop_rad, open_loop(difference, sigma, known)


def _composed_common(camera_lidar: PairEstimate, lidar_radar: PairEstimate) -> np.ndarray | None:
    """What all days err by alike, of both factors."""
    a, b = camera_lidar.common_covariance, lidar_radar.common_covariance
    return None if a is None or b is None else compose_covariance(camera_lidar.T, a, b)


def _composed_observability(
    camera_lidar: PairEstimate, lidar_radar: PairEstimate, prior: Prior
) -> tuple[np.ndarray, np.ndarray]:
    """Observability of the composed pair, and which of its unknowns do not rest on the prior.

    In the record's coordinates, turns about the radar and its position in the camera: an unknown rests on the prior
    where the factors' unobservable unknowns make up half of its variance, or the factors' variance together is no
    better than half of the prior's.
    """
    T = camera_lidar.T @ lidar_radar.T
    to_change = change_jacobian(T)
    variance, of_prior = np.zeros(6), np.zeros(6)
    for estimate, lever in ((camera_lidar, np.eye(6)), (lidar_radar, adjoint(camera_lidar.T))):
        # From the factor's own turn and position to its twist, to the composed twist, to the composed position.
        A = to_change @ lever @ np.linalg.inv(change_jacobian(estimate.T))
        own = change_covariance(estimate.T, estimate.covariance)
        variance += np.diag(A @ own @ A.T)
        unseen = A[:, ~estimate.observable]
        of_prior += np.diag(unseen @ own[np.ix_(~estimate.observable, ~estimate.observable)] @ unseen.T)
    observability = np.clip(1 - variance / np.diag(prior.covariance("camera_radar")), 0.0, 1.0)
    return observability, (observability >= OBSERVABLE) & (of_prior < _MOSTLY * variance)


def _either(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, int]:
    """Frames that one of the factors could not use, by reason."""
    return {reason: a.get(reason, 0) + b.get(reason, 0) for reason in {**a, **b}}


def _time_offset(camera_lidar: PairEstimate, lidar_radar: PairEstimate) -> tuple[float | None, float | None]:
    """stamp_camera = stamp_lidar + dt_cl = stamp_radar + dt_lr + dt_cl."""
    a, b = camera_lidar.time_offset_s, lidar_radar.time_offset_s
    if a is None or b is None:
        return None, None
    return a + b, float(
        np.hypot(camera_lidar.time_offset_sigma_s or 0.0, lidar_radar.time_offset_sigma_s or 0.0)
    )

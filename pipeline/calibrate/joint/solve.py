"""Method `joint`: camera-lidar, then lidar-radar with the camera's help, camera-radar composed of the two.

The hard loop `T_camera_radar = T_camera_lidar T_lidar_radar` leaves 12 unknowns. They are solved one pair after the
other: the camera-lidar terms determine their pose ten times better than any radar term could, so a common last step
would add noise only. Camera-lidar is concluded after lidar-radar: its time offset moves the cloud along the car's way,
whose direction in lidar axes lidar-radar estimates.

A loop that is closed by construction checks nothing, so estimates that took no part are compared with it: camera-radar
without the lidar, disjoint halves of the day, restarts, and the registration's own roll and pitch (`failed_checks`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.calibrate.joint.camera_lidar.estimate import Aligned, align_camera_lidar, analyse_camera_lidar
from pipeline.calibrate.joint.camera_radar import estimate_camera_radar
from pipeline.calibrate.joint.failed_checks import camera_lidar_failures, lidar_radar_failures, open_loop
from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.calibrate.numerics.covariance import OBSERVABLE
from pipeline.config import SolveConfig
from pipeline.errors import SolveError
from pipeline.extrinsics.estimates import PairEstimate, Prior, Solution
from pipeline.geometry.changes import change_covariance, change_jacobian
from pipeline.geometry.se3 import adjoint, compose_covariance, inverse, log_so3
from pipeline.results import Progress, silent
from schemas.calibrations import PAIRS
from schemas.observations import Observation

__all__ = ["compose_pairs", "solve_joint"]

_MOSTLY = 0.5  # of a variance: from there on it is called the prior's
_NO_OFFSET_S, _ANYWHERE_M = (
    1e-4,
    10.0,
)  # sigmas of priors where `terms` leaves time offsets or the position prior out


def solve_joint(
    observations: Mapping[str, Sequence[Observation]],
    prior: Prior,
    config: SolveConfig,
    *,
    seed: int,
    triggered: Sequence[str] = PAIRS,
    progress: Progress = silent,
) -> Solution:
    """Solve all three pairs.

    Args:
        observations: selected frames per pair.
        prior: start and weak prior.
        config: effort.
        seed: decides everything random.
        triggered: pairs to estimate; camera_radar follows from the other two. Others keep the prior.
        progress: told about each pair.

    Returns:
        The solution; a pair that the day cannot determine keeps its prior, with a failed check that says why.
    """
    prior, config = _without_terms(prior, config)
    failed: dict[str, list[str]] = {pair: [] for pair in PAIRS}
    wanted = set(triggered) | ({"camera_lidar", "lidar_radar"} if "camera_radar" in triggered else set())
    progress(0, 3, "camera-lidar")
    rng = np.random.default_rng([seed, 0])
    aligned: Aligned | None = None
    camera_lidar = _unchanged("camera_lidar", prior)
    camera = camera_lidar.T, camera_lidar.covariance
    if "camera_lidar" in wanted:
        try:
            aligned = align_camera_lidar(observations["camera_lidar"], prior, config, rng)
            camera = aligned.T_camera_lidar, aligned.covariance
        except SolveError as err:
            failed["camera_lidar"].append(err.reason)
    progress(1, 3, "lidar-radar")
    lidar_radar = _unchanged("lidar_radar", prior)
    if "lidar_radar" in wanted:
        try:
            lidar_radar = estimate_lidar_radar(
                observations["lidar_radar"],
                prior,
                camera[0],
                config,
                np.random.default_rng([seed, 1]),
                covariance_camera_lidar=camera[1],
            )
        except SolveError as err:
            failed["lidar_radar"].append(err.reason)
    if aligned is not None:
        camera_lidar = analyse_camera_lidar(aligned, rng, heading=_heading(lidar_radar))
    progress(2, 3, "camera-radar")
    own_rng = np.random.default_rng([seed, 2])
    without_lidar = estimate_camera_radar(observations["camera_radar"], prior, config, own_rng)
    camera_radar, loop_rad, contradictions = compose_pairs(camera_lidar, lidar_radar, without_lidar, prior)
    failed["camera_lidar"] += camera_lidar_failures(camera_lidar)
    failed["lidar_radar"] += lidar_radar_failures(lidar_radar)
    failed["camera_radar"] += [*failed["camera_lidar"], *failed["lidar_radar"], *contradictions]
    progress(3, 3, "done")
    pairs = {"camera_lidar": camera_lidar, "camera_radar": camera_radar, "lidar_radar": lidar_radar}
    return Solution("joint", pairs, loop_rad, None, {pair: why for pair, why in failed.items() if why})


def compose_pairs(
    camera_lidar: PairEstimate, lidar_radar: PairEstimate, without_lidar: PairEstimate, prior: Prior
) -> tuple[PairEstimate, float | None, list[str]]:
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
        {},
        *_time_offset(camera_lidar, lidar_radar),
        diagnostics,
        [
            "composed of camera-lidar and lidar-radar, their errors taken as independent",
            "loop: camera-radar without the lidar, rotations only (its translation is the prior's)",
        ],
    )
    loop_rad = float(np.linalg.norm(difference[known])) if known.any() else None
    return estimate, loop_rad, open_loop(difference, sigma, known)


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


def _time_offset(camera_lidar: PairEstimate, lidar_radar: PairEstimate) -> tuple[float | None, float | None]:
    """stamp_camera = stamp_lidar + dt_cl = stamp_radar + dt_lr + dt_cl."""
    a, b = camera_lidar.time_offset_s, lidar_radar.time_offset_s
    if a is None or b is None:
        return None, None
    return a + b, float(
        np.hypot(camera_lidar.time_offset_sigma_s or 0.0, lidar_radar.time_offset_sigma_s or 0.0)
    )


def _without_terms(prior: Prior, config: SolveConfig) -> tuple[Prior, SolveConfig]:
    """Time offsets fixed to zero, and a prior without position, where `terms` leaves those out."""
    if "time_offsets" not in config.terms:
        config = config.model_copy(update={"time_offset_sigma_s": _NO_OFFSET_S})
    if "translation_prior" not in config.terms:
        prior = replace(prior, translation_sigma_m=_ANYWHERE_M)
    return prior, config


def _heading(lidar_radar: PairEstimate) -> tuple[np.ndarray, float] | None:
    """Radar pose and sigma of its yaw [rad], which give the car's heading in lidar axes; None where yaw is unknown."""
    if not lidar_radar.observable[2]:
        return None
    return lidar_radar.T, float(np.sqrt(lidar_radar.covariance[2, 2]))


def _unchanged(pair: str, prior: Prior) -> PairEstimate:
    """The prior, where a pair is not estimated."""
    return PairEstimate(pair, prior.of(pair), prior.covariance(pair), np.zeros(6), np.zeros(6, bool), 0)

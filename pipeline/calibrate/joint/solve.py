"""Method `joint`: camera-lidar, then lidar-radar with the camera's help, camera-radar composed; checked three ways.

Camera-lidar is settled last: its clock moves the cloud along the car's way, which lidar-radar tells in lidar axes.

The hard loop `T_camera_radar = T_camera_lidar T_lidar_radar` leaves 12 unknowns. They are solved one pair after the
other: the camera-lidar terms know their pose ten times better than any radar term could tell them, so a common last
step moves nothing but noise. What a constructed loop cannot show is asked of estimates that were not used:
camera-radar without the lidar, disjoint halves, restarts, and the registration's own opinion of roll and pitch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.calibrate.joint.camera_lidar.estimate import align_camera_lidar, analyse_camera_lidar
from pipeline.calibrate.joint.camera_lidar.initialise import SAME_ROTATION_RAD
from pipeline.calibrate.joint.camera_radar import estimate_camera_radar
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

_SIGMAS = 3.0
_MOSTLY = 0.5  # of a variance: from there on it is called the prior's
_NO_OFFSET_S, _ANYWHERE_M = 1e-4, 10.0
_RESTART_ROTATION_RAD, _RESTART_SHIFT_M = np.radians(0.15), 0.05


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
        The solution; a pair that the day cannot determine keeps its prior, with a doubt that says why.
    """
    prior, config = _without_terms(prior, config)
    failed: dict[str, list[str]] = {pair: [] for pair in PAIRS}
    wanted = set(triggered) | ({"camera_lidar", "lidar_radar"} if "camera_radar" in triggered else set())
    progress(0, 3, "camera-lidar")
    camera_lidar, aligned = _kept("camera_lidar", prior), None
    T_camera_lidar, covariance = camera_lidar.T, camera_lidar.covariance
    rng = np.random.default_rng([seed, 0])
    if "camera_lidar" in wanted:
        try:
            aligned = align_camera_lidar(observations["camera_lidar"], prior, config, rng)
            T_camera_lidar, covariance = aligned.T_camera_lidar, aligned.covariance
        except SolveError as err:
            failed["camera_lidar"].append(err.reason)
    progress(1, 3, "lidar-radar")
    lidar_radar = _kept("lidar_radar", prior)
    if "lidar_radar" in wanted:
        try:
            lidar_radar = estimate_lidar_radar(
                observations["lidar_radar"],
                prior,
                T_camera_lidar,
                config,
                np.random.default_rng([seed, 1]),
                covariance_camera_lidar=covariance,
            )
        except SolveError as err:
            failed["lidar_radar"].append(err.reason)
    if aligned is not None:
        camera_lidar = analyse_camera_lidar(aligned, rng, heading=_heading(lidar_radar))
    progress(2, 3, "camera-radar")
    alone = estimate_camera_radar(
        observations["camera_radar"], prior, config, np.random.default_rng([seed, 2])
    )
    camera_radar, loop_rad, open_loop = compose_pairs(camera_lidar, lidar_radar, alone, prior)
    failed["camera_lidar"] += _camera_lidar_failures(camera_lidar)
    failed["lidar_radar"] += _lidar_radar_failures(lidar_radar)
    failed["camera_radar"] += [*failed["camera_lidar"], *failed["lidar_radar"], *open_loop]
    pairs = {"camera_lidar": camera_lidar, "camera_radar": camera_radar, "lidar_radar": lidar_radar}
    progress(3, 3, "done")
    return Solution("joint", pairs, loop_rad, None, {pair: why for pair, why in failed.items() if why})


def compose_pairs(
    camera_lidar: PairEstimate, lidar_radar: PairEstimate, alone: PairEstimate, prior: Prior
) -> tuple[PairEstimate, float | None, list[str]]:
    """Camera-radar by the loop, and how far the camera-radar estimate that never saw the lidar is from it.

    Returns:
        The composed estimate; the loop's angle over the rotations that `alone` determined (None where it determined
        none; its translation is the prior's, so no translation is compared); failed where that angle is beyond sigma.
    """
    T = camera_lidar.T @ lidar_radar.T
    covariance = compose_covariance(camera_lidar.T, camera_lidar.covariance, lidar_radar.covariance)
    observability, observable = _composed_observability(camera_lidar, lidar_radar, prior)
    difference = log_so3((T @ inverse(alone.T))[:3, :3])
    sigma = np.sqrt(np.diag(covariance)[:3] + np.diag(alone.covariance)[:3])
    known = alone.observable[:3]
    failed = [
        f"without the lidar {name} turns by {np.degrees(d):+.2f} deg against the loop, sigma {np.degrees(s):.2f} deg"
        for name, d, s, k in zip(("pitch", "yaw", "roll"), -difference, sigma, known, strict=True)
        if k and abs(d) > _SIGMAS * s
    ]
    loop_rad = float(np.linalg.norm(difference[known])) if known.any() else None
    diagnostics = {f"alone_{k}": v for k, v in alone.diagnostics.items()}
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
    return estimate, loop_rad, failed


def _composed_observability(
    camera_lidar: PairEstimate, lidar_radar: PairEstimate, prior: Prior
) -> tuple[np.ndarray, np.ndarray]:
    """Observability of the composed pair, and which of its unknowns do not rest on the prior.

    Counted as the record shows them, turns about the radar and its position in the camera: an unknown rests on the
    prior where the factors' unobservable unknowns make up half of its variance, or the factors' variance together is
    no better than half of the prior's.
    """
    T = camera_lidar.T @ lidar_radar.T
    to_change = change_jacobian(T)
    variance, kept = np.zeros(6), np.zeros(6)
    for estimate, lever in ((camera_lidar, np.eye(6)), (lidar_radar, adjoint(camera_lidar.T))):
        # From the factor's own turn and position to its twist, to the composed twist, to the composed position.
        A = to_change @ lever @ np.linalg.inv(change_jacobian(estimate.T))
        own = change_covariance(estimate.T, estimate.covariance)
        variance += np.diag(A @ own @ A.T)
        unseen = A[:, ~estimate.observable]
        kept += np.diag(unseen @ own[np.ix_(~estimate.observable, ~estimate.observable)] @ unseen.T)
    observability = np.clip(1 - variance / np.diag(prior.covariance("camera_radar")), 0.0, 1.0)
    return observability, (observability >= OBSERVABLE) & (kept < _MOSTLY * variance)


def _time_offset(camera_lidar: PairEstimate, lidar_radar: PairEstimate) -> tuple[float | None, float | None]:
    """stamp_camera = stamp_lidar + dt_cl = stamp_radar + dt_lr + dt_cl."""
    a, b = camera_lidar.time_offset_s, lidar_radar.time_offset_s
    if a is None or b is None:
        return None, None
    return a + b, float(
        np.hypot(camera_lidar.time_offset_sigma_s or 0.0, lidar_radar.time_offset_sigma_s or 0.0)
    )


def _camera_lidar_failures(estimate: PairEstimate) -> list[str]:
    """A best end that no other restart came near may be one of several optima: its sigma knows only its own."""
    apart_deg = estimate.diagnostics.get("restart_rotation_spread_deg", 0.0)
    if apart_deg <= np.degrees(SAME_ROTATION_RAD):
        return []
    return [f"no restart vouches for the optimum: the nearest other end is {apart_deg:.1f} deg away"]


def _lidar_radar_failures(estimate: PairEstimate) -> list[str]:
    """Restarts, halves, and the registration against the camera's boxes."""
    d = estimate.diagnostics
    failed: list[str] = []
    if not d:
        return failed
    sigma = np.sqrt(np.diag(estimate.covariance))
    # Restarts end where finishing begins: only what would be another basin counts, and only in what is claimed.
    for k, name, key, least in (
        (2, "yaw", "restarts_rz_rad", _RESTART_ROTATION_RAD),
        (3, "x", "restarts_tx_m", _RESTART_SHIFT_M),
        (4, "y", "restarts_ty_m", _RESTART_SHIFT_M),
    ):
        if estimate.observable[k] and abs(d[key]) > max(least, _SIGMAS * sigma[k]):
            failed.append(f"restarts disagree in {name} by {_size(k, d[key])}")
    # Two halves differ by twice the error of the whole, if their errors are independent.
    for k, (name, key) in enumerate(
        zip(
            ("roll", "pitch", "yaw", "x", "y", "z"),
            ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m"),
            strict=True,
        )
    ):
        if estimate.observable[k] and abs(d[f"halves_{key}"]) > _SIGMAS * 2 * sigma[k]:
            failed.append(f"disjoint halves disagree in {name} by {_size(k, d[f'halves_{key}'])}")
    for k, name in ((0, "roll"), (1, "pitch")):
        offset, floor = d[f"registration_{name}_offset_rad"], d[f"registration_{name}_sigma_rad"]
        if estimate.observable[k] and abs(offset) > _SIGMAS * np.hypot(floor, sigma[k]):
            failed.append(
                f"the registration would turn {name} by {np.degrees(offset):+.1f} deg, camera and prior would not"
            )
    return failed


def _without_terms(prior: Prior, config: SolveConfig) -> tuple[Prior, SolveConfig]:
    """Time offsets nailed to zero, and a prior that knows no position, where `terms` leaves those out."""
    if "time_offsets" not in config.terms:
        config = config.model_copy(update={"time_offset_sigma_s": _NO_OFFSET_S})
    if "translation_prior" not in config.terms:
        prior = replace(prior, translation_sigma_m=_ANYWHERE_M)
    return prior, config


def _heading(lidar_radar: PairEstimate) -> tuple[np.ndarray, float] | None:
    """What lidar-radar found of the way the car goes in the lidar's axes; None where it did not find its yaw."""
    if not lidar_radar.observable[2]:
        return None
    return lidar_radar.T, float(np.sqrt(lidar_radar.covariance[2, 2]))


def _size(k: int, value: float) -> str:
    return f"{np.degrees(value):+.2f} deg" if k < 3 else f"{value:+.3f} m"


def _kept(pair: str, prior: Prior) -> PairEstimate:
    """The prior, where a pair is not estimated."""
    return PairEstimate(pair, prior.of(pair), prior.covariance(pair), np.zeros(6), np.zeros(6, bool), 0)

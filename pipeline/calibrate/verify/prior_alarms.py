"""Alarms: a mounting or a clock that the day puts many sigmas from its prior.

A degree of freedom that the day leaves at the prior has the prior's error, even if that exceeds the stated
sigma. So each other source of information on such a prior is compared with it. One is the pair's own day
without the prior, which is too uncertain to be a result but may still be ten sigmas away. The other is the
other pair of the same sensor. If the camera finds the lidar .3 m lower than tf_static, one of the two is
mounted elsewhere; if it is the lidar, the radar's height above it has the same error, and nothing in
lidar-radar shows it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.config import ChecksConfig
from pipeline.rig.changes import change_between, change_covariance, change_jacobian
from pipeline.rig.checks import FailedCheck
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.targets import target_jacobian, target_sigmas
from schemas.calibrations import DOF_NAMES

__all__ = ["clock_alarms", "edge_alarms", "prior_alarms"]

# By which the day's own position must differ as well, where frames confirm it; else as many as of the prior.
_OF_DAY_SIGMAS = 2.0
_DENIES_SIGMAS = 3.0
# Normal deviates by which frames align better at the radar's own position than at the prior, and than as far beyond.
# On 43 good days of ten rigs one of the two was above -0.9: the cost slopes there, and does not dip.
_CLEARLY_Z = 1.5
# By which a time offset beyond all that is searched must stand out more than the solution's own. On 42 good days the
# one more than 0.12 s from the solution did so by 0.7; where clocks were 0.5 s off it was 0.8 to 5, in lidar-radar 3 to
# 6.
_ELSEWHERE_Z = 2.0
_LIDAR_PAIRS = ("camera_lidar", "lidar_radar")


def prior_alarms(
    pairs: Mapping[str, PairEstimate], prior: Prior, limits: ChecksConfig
) -> dict[str, list[FailedCheck]]:
    """Positions left at the prior that the day's data contradict."""
    sigma_m = f"{prior.translation_sigma_m:g}"
    return {
        pair: [
            FailedCheck(
                f"the day itself puts {DOF_NAMES[k]} {shift:+.2f} +- {own:.2f} m from the prior, whose sigma is"
                f" {sigma_m} m: measure the mounting",
                "prior",
            )
            for k, (shift, own) in _own_positions(estimate).items()
            if _is_far(estimate, k, prior, limits)
        ]
        for pair, estimate in pairs.items()
    }


def _own_positions(estimate: PairEstimate) -> dict[int, tuple[float, float]]:
    """The day's own shift from a prior that it could not improve, and its sigma [m], by index."""
    d = estimate.diagnostics
    keys = {k: f"own_{DOF_NAMES[k]}" for k in range(3, 6)}
    return {k: (d[f"{name}_m"], d[f"{name}_sigma_m"]) for k, name in keys.items() if f"{name}_m" in d}


def _is_far(estimate: PairEstimate, k: int, prior: Prior, limits: ChecksConfig) -> bool:
    """Whether the day's position differs from the prior by many sigmas (of prior and day)."""
    z = [estimate.diagnostics[n] for n in ("own_z_prior", "own_z_beyond") if n in estimate.diagnostics]
    shift, own = _own_positions(estimate)[k]
    many = limits.max_move_prior_sigmas
    least = np.hypot(many * prior.translation_sigma_m, (_OF_DAY_SIGMAS if z else many) * own)
    return bool(abs(shift) > least) and all(value < -_CLEARLY_Z for value in z)


def clock_alarms(
    pairs: Mapping[str, PairEstimate], sigma_s: float, limits: ChecksConfig
) -> dict[str, list[FailedCheck]]:
    """Time offsets beyond `time_offset_sigma_s`, estimated or at the end of the search range."""
    out = {}
    for pair, estimate in pairs.items():
        dt_s, own_s, found = estimate.time_offset_s, estimate.time_offset_sigma_s or 0.0, estimate.diagnostics
        if dt_s is None:
            continue
        many = limits.max_move_prior_sigmas * float(np.hypot(sigma_s, own_s))
        far_s = found.get("own_dt_s", dt_s)
        is_elsewhere = abs(far_s - dt_s) > many and abs(found.get("own_dt_z", 0.0)) > _ELSEWHERE_Z
        shown = f"{1e3 * (far_s if is_elsewhere else dt_s):+.0f} ms, far beyond time_offset_sigma_s"
        if is_elsewhere:
            shown = f"frames align far better with stamps moved by {shown} ({1e3 * sigma_s:.0f} ms)"
        elif abs(dt_s) > many:
            shown = f"the stamps are apart by {shown} ({1e3 * sigma_s:.0f} ms)"
        else:
            continue
        out[pair] = [FailedCheck(f"{shown}: set the clocks, or state how far they may be off", "time_offset")]
    return out


def edge_alarms(
    pairs: Mapping[str, PairEstimate], prior: Prior, limits: ChecksConfig
) -> dict[str, list[FailedCheck]]:
    """Alarms for camera-lidar or lidar-radar if the other one contradicts the lidar's mounting on which it depends."""
    out = {}
    for seen, resting in (_LIDAR_PAIRS, _LIDAR_PAIRS[::-1]):
        if not {seen, resting} <= pairs.keys() or pairs[seen].disproved:
            continue
        step = _contradicted(pairs[seen], prior, limits)
        # A lidar that is off shows in both pairs, by as much and the other way round.
        R = prior.T_camera_lidar[:3, :3]
        into = R.T if seen == "camera_lidar" else R
        hidden = -np.concatenate([into @ step[:3], into @ step[3:]])
        if not step.any() or not _rests_on(pairs[resting], prior, hidden, limits):
            continue
        axes = ", ".join(DOF_NAMES[k] for k in np.flatnonzero(_kept(pairs[resting], hidden)))
        why = f"{seen} contradicts the prior: if it is the lidar that is mounted elsewhere, then {axes} is wrong"
        out[resting] = [FailedCheck(f"{why} here, where the day left it to the prior", "prior")]
    return out


def _contradicted(estimate: PairEstimate, prior: Prior, limits: ChecksConfig) -> Float[np.ndarray, " 6"]:
    """The change from the prior if it is many sigmas; else 0."""
    step = change_between(prior.of(estimate.pair), estimate.T)
    far = limits.max_move_prior_sigmas * np.sqrt(np.diag(prior.covariance(estimate.pair)))
    step = np.where(estimate.observable & (np.abs(step) > far), step, 0.0)
    for k, (shift, _) in _own_positions(estimate).items():
        step[k] = shift if _is_far(estimate, k, prior, limits) else step[k]
    return np.asarray(step)


def _kept(resting: PairEstimate, hidden: Float[np.ndarray, " 6"]) -> Bool[np.ndarray, " 6"]:
    """Axes that the pair left at a prior that the other pair contradicts."""
    size = np.repeat([np.linalg.norm(hidden[:3]), np.linalg.norm(hidden[3:])], 3)
    return ~resting.observable & (np.abs(hidden) > 0.3 * size)


def _rests_on(
    resting: PairEstimate, prior: Prior, hidden: Float[np.ndarray, " 6"], limits: ChecksConfig
) -> bool:
    """Whether an error of the prior would move targets by more than their sigma, and the pair does not measure it."""
    far = limits.max_move_prior_sigmas * np.sqrt(np.diag(prior.covariance(resting.pair)))
    own = change_between(prior.of(resting.pair), resting.T)
    sigma = np.sqrt(np.diag(change_covariance(resting.T, resting.covariance)))
    knows = resting.observable.copy()
    for k, (shift, own_sigma) in _own_positions(resting).items():
        own[k], sigma[k], knows[k] = shift, own_sigma, True
    differs = np.abs(own - hidden) > np.maximum(0.5 * np.abs(hidden), _DENIES_SIGMAS * sigma)
    if np.any(knows & differs & (np.abs(hidden) > far)):
        return False
    covariance = change_covariance(resting.T, resting.covariance)
    J = target_jacobian(resting.pair, resting.T) @ np.linalg.inv(change_jacobian(resting.T))
    effect = np.zeros(J.shape[:2])
    for axis in np.flatnonzero(_kept(resting, hidden)):
        # All others follow the unknowns kept at the prior.
        effect += J @ (covariance[:, axis] / covariance[axis, axis] * hidden[axis])
    sigmas = target_sigmas(resting.pair, resting.T, resting.covariance)
    return bool(np.any(np.sqrt((effect**2).mean(1)) > sigmas))

"""Accept, hold or refuse: held-out frames decide, doubts hold, and nothing worse than the prior passes.

Held means: computed and recorded, but the prior stays current.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry.se3 import adjoint, inverse, log_so3
from pipeline.objective.problem import PairEstimate, Solution
from pipeline.verify.holdout import HeldOutTest
from schemas.calibrations import DOF_NAMES

__all__ = ["Limits", "Verdict", "judge", "loop_doubts", "moved"]


@dataclass(frozen=True)
class Limits:
    """What the verdict measures by."""

    search_rotation_rad: float
    search_translation_m: float
    prior_sigmas: float = 4.0  # a move this large happens once in 16,000 days if the prior's sigma is right
    worse_z: float = 1.64  # one-sided 5 %: a right result is held by chance once in 20 days at most
    # One-sided 16 %: short days hold out some ten frames, and 5 % would hold right results that moved by 10 cm.
    better_z: float = 1.0
    agree_sigmas: float = 3.0
    min_frames: int = 8
    min_holdout: int = 3


@dataclass(frozen=True)
class Verdict:
    """Status of a record and the reason in words."""

    status: str
    reason: str


def judge(
    estimate: PairEstimate,
    T_prior: Float[np.ndarray, "4 4"],
    prior_covariance: Float[np.ndarray, "6 6"],
    test: HeldOutTest | None,
    doubts: Sequence[str],
    limits: Limits,
    *,
    calibrated: bool = True,
    factors: Sequence[Verdict] = (),
) -> Verdict:
    """Decide on one pair.

    Args:
        estimate: the result.
        T_prior: what stands without it.
        prior_covariance: of the prior, order as the estimate's.
        test: held-out frames at prior and result; None where no frame could tell.
        doubts: reasons found while solving for not trusting the pair.
        limits: thresholds.
        calibrated: False where no trigger asked for this pair.
        factors: verdicts of the pairs that this one is composed of; empty where it was estimated. A composed pair is as
            good as its factors: it need not align better on its own held-out frames, but it may not align worse.
    """
    if not calibrated:
        return Verdict("held", "not triggered: the prior stays")
    if estimate.frames_used < limits.min_frames:
        few = f"too few frames: {estimate.frames_used}, needs {limits.min_frames}"
        return Verdict("refused", "; ".join([*doubts, few]))
    reasons = [*doubts, *_range_reasons(estimate, T_prior, prior_covariance, limits)]
    if not estimate.observable.any():
        reasons.append("the day determines no degree of freedom")
    if factors:
        reasons += (
            []
            if all(f.status == "accepted" for f in factors)
            else ["composed of a pair that is not accepted"]
        )
        reasons += _worse(test, limits)
    else:
        reasons += _holdout_reasons(estimate, T_prior, test, limits)
    if reasons:
        return Verdict("held", "; ".join(reasons))
    kept = [name for name, seen in zip(DOF_NAMES, estimate.observable, strict=True) if not seen]
    return Verdict("accepted", f"not determined by the day: {', '.join(kept)}" if kept else "")


def moved(T: Float[np.ndarray, "4 4"], T_prior: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
    """How far T lies from the prior: rotation vector in parent axes [rad], then shift of the child's origin [m]."""
    return np.concatenate([log_so3(T[:3, :3] @ T_prior[:3, :3].T), T[:3, 3] - T_prior[:3, 3]])


def loop_doubts(solution: Solution, sigmas: float = 3.0) -> list[str]:
    """A loop of independent estimates that does not close within its sigma is a doubt about every pair."""
    if solution.loop_rotation_rad is None or solution.loop_translation_m is None:
        return []
    covariance = _loop_covariance(solution)
    rotation = float(np.sqrt(np.trace(covariance[:3, :3])))
    translation = float(np.sqrt(np.trace(covariance[3:, 3:])))
    doubts = []
    if solution.loop_rotation_rad > sigmas * rotation:
        open_deg, sigma_deg = np.degrees(solution.loop_rotation_rad), np.degrees(rotation)
        doubts.append(f"the loop is open by {open_deg:.2f} deg, its sigma is {sigma_deg:.2f} deg")
    if solution.loop_translation_m > sigmas * translation:
        doubts.append(
            f"the loop is open by {solution.loop_translation_m:.3f} m, its sigma is {translation:.3f} m"
        )
    return doubts


def _loop_covariance(solution: Solution) -> np.ndarray:
    """Of T_camera_lidar T_lidar_radar T_radar_camera, with independent factors (first order)."""
    cl, lr, cr = (solution.pairs[p] for p in ("camera_lidar", "lidar_radar", "camera_radar"))
    A = adjoint(cl.T)
    B = adjoint(cl.T @ lr.T @ inverse(cr.T))
    return cl.covariance + A @ lr.covariance @ A.T + B @ cr.covariance @ B.T


def _range_reasons(
    estimate: PairEstimate, T_prior: np.ndarray, prior_covariance: np.ndarray, limits: Limits
) -> list[str]:
    step = moved(estimate.T, T_prior)
    reasons = []
    rotation, translation = np.linalg.norm(step[:3]), np.abs(step[3:]).max()
    # The searched box has half-widths per axis: its corners lie sqrt(3) further out.
    if rotation > np.sqrt(3) * limits.search_rotation_rad:
        reasons.append(f"moved {np.degrees(rotation):.1f} deg, beyond the search range")
    if translation > limits.search_translation_m:
        reasons.append(f"moved {translation:.2f} m, beyond the search range")
    ratio = np.abs(step) / np.sqrt(np.diag(prior_covariance))
    worst = int(np.argmax(ratio))
    if ratio[worst] > limits.prior_sigmas:
        reasons.append(f"{DOF_NAMES[worst]} moved {ratio[worst]:.1f} prior sigmas")
    return reasons


def _holdout_reasons(
    estimate: PairEstimate, T_prior: np.ndarray, test: HeldOutTest | None, limits: Limits
) -> list[str]:
    if test is None or test.frames < limits.min_holdout:
        return [
            f"too few held-out frames to judge: {0 if test is None else test.frames}, needs {limits.min_holdout}"
        ]
    if test.z > limits.worse_z or test.z < -limits.better_z:
        return _worse(test, limits)
    # Neither better nor worse: fine as long as the result says the same as the prior.
    sigma = np.sqrt(np.diag(estimate.covariance))
    ratio = np.where(estimate.observable, np.abs(moved(estimate.T, T_prior)) / sigma, 0.0)
    worst = int(np.argmax(ratio))
    if ratio[worst] > limits.agree_sigmas:
        claim = f"{DOF_NAMES[worst]} moved {ratio[worst]:.1f} of its sigmas"
        return [f"{claim}, and held-out frames align no better (z = {test.z:.1f})"]
    return []


def _worse(test: HeldOutTest | None, limits: Limits) -> list[str]:
    if test is None or test.z <= limits.worse_z:
        return []
    change = f"{test.after:.4g} after {test.before:.4g}, z = {test.z:.1f}"
    return [f"held-out frames align worse than at the prior ({change})"]

"""Accept, hold or refuse: every check has a margin, the smallest is the score, and one below zero holds the record.

Held means: computed and recorded, but the prior stays current. Accepted means that the record vouches for what it
names in `determined`: azimuth, and elevation where the day tells it, of targets 15 to 40 m away, within a stated limit.

Thresholds were chosen on simulated days of seeds 140 to 145 (demo and paper rig, 40 frames, 24 good days and 28 with
faults), and on the real day for the question what methods that are .3 to .8 deg off look like.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.verify.held_out_test import HeldOutTest
from pipeline.calibrate.verify.target_accuracy import Claim
from pipeline.extrinsics.estimates import PairEstimate, Prior, Solution
from pipeline.geometry.changes import change_covariance
from pipeline.geometry.se3 import adjoint, inverse, log_so3
from pipeline.geometry.targets import DEFAULT_TARGETS
from schemas.calibrations import DOF_NAMES
from schemas.observations import Observation

__all__ = ["Limits", "Verdict", "heading_doubts", "judge", "loop_doubts", "loop_sigmas", "moved"]

# What a pair is good for: without it there is nothing to accept. A radar without elevation is still worth its azimuth.
_NEEDED = {
    "camera_lidar": ("azimuth", "elevation"),
    "camera_radar": ("azimuth",),
    "lidar_radar": ("azimuth",),
}
# What held-out frames can tell apart: registration and boxes say nothing of the radar's elevation.
_JUDGED = {
    "camera_lidar": np.ones(6, bool),
    "camera_radar": np.array([False, True, False, False, False, False]),
    "lidar_radar": np.array([False, False, True, True, True, False]),
}
_ASIDE = 0.25  # share of the limit that a wrong heading may take
_BAD = -1.0  # margin of what is wrong without being measured


@dataclass(frozen=True)
class Limits:
    """What the verdict measures by."""

    search_rotation_rad: float
    search_translation_m: float
    prior_sigmas: float = 4.0  # a move this large happens once in 16,000 days if the prior's sigma is right
    worse_z: float = 2.33  # one-sided 1 %: a right result near a good prior aligns worse by chance
    # One-sided 16 %: short days hold out some ten frames, and 5 % would hold right results that moved by 10 cm.
    better_z: float = 1.0
    agree_sigmas: float = 4.0  # the largest of six, where held-out frames are too few to tell
    min_frames: int = 8
    min_holdout: int = 3


@dataclass(frozen=True)
class Verdict:
    """Status of a record, the reason in words, the smallest margin, and what an accepted record vouches for."""

    status: str
    reason: str
    score: float = 0.0
    determined: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class _Check:
    """One thing that must hold: margin 1 = far inside, 0 = at the limit; the reason is said where it is negative."""

    margin: float
    reason: str


def judge(
    estimate: PairEstimate,
    T_prior: Float[np.ndarray, "4 4"],
    prior_covariance: Float[np.ndarray, "6 6"],
    test: HeldOutTest | None,
    claims: Mapping[str, Claim],
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
        claims: what can be said of azimuth and elevation at the targets.
        doubts: reasons found while solving for not trusting the pair.
        limits: thresholds.
        calibrated: False where no trigger asked for this pair.
        factors: verdicts of the pairs that this one is composed of; empty where it was estimated. A composed pair is as
            good as its factors: how far it moved is theirs to answer for, and it need not align better on its own
            held-out frames, but it may not align worse, nor may they contradict it.
    """
    if not calibrated:
        return Verdict("held", "not triggered: the prior stays", _BAD)
    if estimate.frames_used < limits.min_frames:
        few = f"too few frames: {estimate.frames_used}, needs {limits.min_frames}"
        return Verdict("refused", "; ".join([*doubts, few]), _BAD)
    checks = [_Check(_BAD, doubt) for doubt in doubts]
    if factors:
        good = all(f.status == "accepted" for f in factors)
        checks.append(
            _Check(min(f.score for f in factors) if good else _BAD, "composed of a pair that is not accepted")
        )
        checks += _not_worse(estimate, T_prior, test, limits)
    else:
        checks += _moves(estimate, T_prior, prior_covariance, limits)
        checks += _held_out(estimate, T_prior, test, limits)
    checks += _claims(estimate, claims)
    if not estimate.observable.any():
        checks.append(_Check(_BAD, "the day determines no degree of freedom"))
    score = min(1.0, *(c.margin for c in checks))
    reasons = [c.reason for c in checks if c.margin < 0]
    if reasons:
        return Verdict("held", "; ".join(reasons), score)
    vouched = tuple(name for name, claim in claims.items() if claim.margin >= 0)
    return Verdict("accepted", _remark(estimate, claims), score, vouched)


def moved(T: Float[np.ndarray, "4 4"], T_prior: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
    """How far T lies from the prior: rotation vector in parent axes [rad], then shift of the child's origin [m]."""
    return np.concatenate([log_so3(T[:3, :3] @ T_prior[:3, :3].T), T[:3, 3] - T_prior[:3, 3]])


def loop_doubts(solution: Solution, sigmas: float = 3.0) -> list[str]:
    """A loop of independent estimates that does not close within its sigma is a doubt about every pair."""
    found = loop_sigmas(solution)
    if found is None or solution.loop_rotation_rad is None or solution.loop_translation_m is None:
        return []
    rotation, translation = found
    doubts = []
    if solution.loop_rotation_rad > sigmas * rotation:
        open_deg, sigma_deg = np.degrees(solution.loop_rotation_rad), np.degrees(rotation)
        doubts.append(f"the loop is open by {open_deg:.2f} deg, its sigma is {sigma_deg:.2f} deg")
    if solution.loop_translation_m > sigmas * translation:
        doubts.append(
            f"the loop is open by {solution.loop_translation_m:.3f} m, its sigma is {translation:.3f} m"
        )
    return doubts


def heading_doubts(
    solution: Solution,
    prior: Prior,
    observations: Sequence[Observation],
    limit_rad: float,
    sigmas: float = 3.0,
) -> list[str]:
    """A camera's time offset moves the cloud along the car's heading, which the radar's prior tells.

    Where lidar-radar finds the radar turned by many of the prior's sigmas, camera-lidar was solved along a wrong
    heading: time offset times speed times that turn is how far aside.
    """
    dt_s = solution.pairs["camera_lidar"].time_offset_s or 0.0
    turn = abs(float(moved(solution.pairs["lidar_radar"].T, prior.T_lidar_radar)[2]))
    speeds = [abs(o.ego_speed_mps) for o in observations if o.ego_speed_mps is not None]
    if not speeds or turn < sigmas * prior.rotation_sigma_rad:
        return []
    aside_m = turn * abs(dt_s) * float(np.mean(speeds))
    nearness = float(np.sqrt(np.mean(1 / np.sum(DEFAULT_TARGETS**2, axis=1))))
    if aside_m * nearness < _ASIDE * limit_rad:
        return []
    turned = f"solved along a heading that lidar-radar turns by {np.degrees(turn):.1f} deg"
    return [f"{turned}: {aside_m:.2f} m aside in the camera's time offset"]


def loop_sigmas(solution: Solution) -> tuple[float, float] | None:
    """Sigma of the loop's angle [rad] and translation [m] where all three pairs were estimated apart."""
    if solution.loop_rotation_rad is None or solution.loop_translation_m is None:
        return None
    covariance = _loop_covariance(solution)
    return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.sqrt(np.trace(covariance[3:, 3:])))


def _loop_covariance(solution: Solution) -> np.ndarray:
    """Of T_camera_lidar T_lidar_radar T_radar_camera, with independent factors (first order)."""
    cl, lr, cr = (solution.pairs[p] for p in ("camera_lidar", "lidar_radar", "camera_radar"))
    A = adjoint(cl.T)
    B = adjoint(cl.T @ lr.T @ inverse(cr.T))
    return cl.covariance + A @ lr.covariance @ A.T + B @ cr.covariance @ B.T


def _moves(
    estimate: PairEstimate, T_prior: np.ndarray, prior_covariance: np.ndarray, limits: Limits
) -> list[_Check]:
    """Within what was searched, and within what the prior allows."""
    step = moved(estimate.T, T_prior)
    rotation, translation = float(np.linalg.norm(step[:3])), float(np.abs(step[3:]).max())
    # The searched box has half-widths per axis: its corners lie sqrt(3) further out.
    reach = np.sqrt(3) * limits.search_rotation_rad
    ratio = np.abs(step) / np.sqrt(np.diag(prior_covariance))
    worst = int(np.argmax(ratio))
    return [
        _Check(1 - rotation / reach, f"moved {np.degrees(rotation):.1f} deg, beyond the search range"),
        _Check(
            1 - translation / limits.search_translation_m,
            f"moved {translation:.2f} m, beyond the search range",
        ),
        _Check(
            1 - ratio[worst] / limits.prior_sigmas,
            f"{DOF_NAMES[worst]} moved {ratio[worst]:.1f} prior sigmas",
        ),
    ]


def _held_out(
    estimate: PairEstimate, T_prior: np.ndarray, test: HeldOutTest | None, limits: Limits
) -> list[_Check]:
    """Held-out frames align better than at the prior, or as well where the result says the same as the prior."""
    if test is None or test.frames < limits.min_holdout:
        found = 0 if test is None else test.frames
        return [_Check(_BAD, f"too few held-out frames to judge: {found}, needs {limits.min_holdout}")]
    name, ratio = _largest_move(estimate, T_prior)
    same, better = 1 - ratio / limits.agree_sigmas, (-test.z - limits.better_z) / limits.better_z
    if test.z > limits.worse_z:
        return [_Check(1 - test.z / limits.worse_z, _worse(test))]
    claim = f"{name} moved {ratio:.1f} of its sigmas"
    return [
        _Check(
            min(1.0, max(same, better)),
            f"{claim}, and held-out frames align no better (z = {test.z:.1f})",
        )
    ]


def _not_worse(
    estimate: PairEstimate, T_prior: np.ndarray, test: HeldOutTest | None, limits: Limits
) -> list[_Check]:
    """Of a composed pair: no worse than a prior that the result, by its own sigma, contradicts."""
    if test is None:
        return []
    _, ratio = _largest_move(estimate, T_prior)
    return [_Check(min(1.0, max(1 - ratio / limits.agree_sigmas, 1 - test.z / limits.worse_z)), _worse(test))]


def _largest_move(estimate: PairEstimate, T_prior: np.ndarray) -> tuple[str, float]:
    """The degree of freedom that moved most of those that held-out frames can tell, in sigmas of the result."""
    sigma = np.sqrt(np.diag(change_covariance(estimate.T, estimate.covariance)))
    told = estimate.observable & _JUDGED[estimate.pair]
    ratio = np.where(told, np.abs(moved(estimate.T, T_prior)) / sigma, 0.0)
    worst = int(np.argmax(ratio))
    return DOF_NAMES[worst], float(ratio[worst])


def _worse(test: HeldOutTest) -> str:
    change = f"{test.after:.4g} after {test.before:.4g}, z = {test.z:.1f}"
    return f"held-out frames align worse than at the prior ({change})"


def _claims(estimate: PairEstimate, claims: Mapping[str, Claim]) -> list[_Check]:
    """Held-out frames must not contradict the result, and what the pair is good for must be known well enough."""
    checks = []
    for name, claim in claims.items():
        checks.append(
            _Check(
                claim.agreement,
                f"held-out frames would move the {name} by {_deg(claim.shift)},"
                f" sigma of that {_deg(claim.shift_sigma)}",
            )
        )
        if name in _NEEDED[estimate.pair]:
            checks.append(_Check(claim.margin, f"{name} is {_known(claim)}"))
    return checks


def _known(claim: Claim) -> str:
    off = f"{_deg(claim.shift)} off by held-out frames and " if claim.shift > claim.remaining else ""
    share = f"{100 * claim.confidence:.3g} %"
    return f"{off}known to {_deg(claim.remaining)} (1 sigma), not within {_deg(claim.limit)} at {share}"


def _remark(estimate: PairEstimate, claims: Mapping[str, Claim]) -> str:
    """What an accepted record does not vouch for."""
    remarks = [
        f"{name} not vouched for: {_known(claim)}" for name, claim in claims.items() if claim.margin < 0
    ]
    kept = [name for name, seen in zip(DOF_NAMES, estimate.observable, strict=True) if not seen]
    return "; ".join([*remarks, *([f"not determined by the day: {', '.join(kept)}"] if kept else [])])


def _deg(angle_rad: float) -> str:
    return f"{np.degrees(angle_rad):.2f} deg"

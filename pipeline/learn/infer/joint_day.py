"""Camera-lidar of a vehicle-day from all frames together: candidates, vote, climb, covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.learn.infer.aggregate import measured_estimate
from pipeline.learn.infer.class_evidence import FrameEvidence
from pipeline.learn.infer.joint_fit import APART_RAD, JointFit, climbed, fit_of, rival_score, voted
from pipeline.rig.checks import FailedCheck
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.se3 import inverse, rotation_angle_rad

__all__ = ["JOINT_BIAS_SIGMA", "JointDay", "fitted_day"]

_ROUNDS, _CONVERGED_RAD = 3, np.radians(0.1)  # of choosing points anew where the fit has turned
_CLEAR_SIGMAS = 3.0  # by which frames must prefer the fit to the best other place
# Sigma of what all frames err by alike, (bearing rotation [rad], translation [m]) in the camera's frame: chosen by how
# far days of several rigs err beyond their sigma. Ahead they err by 0.1 m, to one side: labels reach beyond their
# things. How far kinds of evidence disagree on a day was tried in its place: in the valleys of few scenes it explodes.
JOINT_BIAS_SIGMA = np.array([*np.radians([0.05, 0.03, 0.1]), 0.015, 0.015, 0.15])


@dataclass(frozen=True, eq=False)
class JointDay:
    """A day's frames with their fit, and checks that it failed."""

    frames: Sequence[FrameEvidence]
    block: Int[np.ndarray, " F"]
    fit: JointFit
    failed: list[FailedCheck]

    def estimate(self, prior: Prior, rows: Bool[np.ndarray, " F"] | None = None) -> PairEstimate:
        """Of camera-lidar, by all frames or by some."""
        T_prior, covariance = prior.of("camera_lidar"), prior.covariance("camera_lidar")
        fit = self.fit
        if rows is not None:
            some = [frame for frame, kept in zip(self.frames, rows, strict=True) if kept]
            fit = fit_of(some, self.block[rows], fit.T, T_prior, covariance)
        return measured_estimate(fit.T, fit.information, JOINT_BIAS_SIGMA, T_prior, covariance, fit.frames)


def fitted_day(
    evidence: Callable[[np.ndarray], list[FrameEvidence]],
    block: Int[np.ndarray, " F"],
    candidates: Sequence[Float[np.ndarray, "4 4"]],
    prior: Prior,
) -> JointDay | None:
    """Vote, optimise and select points again until the fit is stable; None if the network has no evidence.

    Args:
        evidence: of all frames, points chosen through a pose.
        candidates: poses that rounds and single frames found; the first ones are on no better footing than
            others.
    """
    T_prior, covariance = prior.of("camera_lidar"), prior.covariance("camera_lidar")
    frames = evidence(candidates[-1])
    if not frames:
        return None
    ordered = voted(frames, candidates)
    T = climbed(frames, ordered[0], T_prior, covariance)
    others = [C for C in ordered if float(rotation_angle_rad(C @ inverse(T))) > APART_RAD]
    failed = []
    if others:
        rival = climbed(frames, others[0], T_prior, covariance)
        clear = rival_score(frames, block, T, rival)
        failed = _not_clear(abs(clear), T, rival)
        T = T if clear > 0 else rival
    for _ in range(_ROUNDS):
        before, frames = T, evidence(T)
        fit = fit_of(frames, block, T, T_prior, covariance)
        T = fit.T
        if float(rotation_angle_rad(T @ inverse(before))) < _CONVERGED_RAD:
            break
    return JointDay(frames, block, fit, failed)


def _not_clear(sigmas: float, T: np.ndarray, T_rival: np.ndarray) -> list[FailedCheck]:
    if sigmas >= _CLEAR_SIGMAS:
        return []
    apart = np.degrees(float(rotation_angle_rad(T @ inverse(T_rival))))
    sentence = f"frames do not agree: they fit {apart:.1f} deg apart nearly as well ({sigmas:.1f} sigmas)"
    return [FailedCheck(sentence, "witnesses_disagree")]

"""Camera-lidar of a vehicle-day from all frames together: candidates, vote, climb, covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from pipeline.learn.infer.aggregate import measured_estimate
from pipeline.learn.infer.class_evidence import FrameEvidence, scores
from pipeline.rig.checks import Check
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.se3 import exp_se3, inverse, log_se3, rotation_angle_rad

__all__ = [
    "APART_RAD", "JOINT_BIAS_SIGMA", "JointDay", "JointFit", "climbed", "fit_of", "fitted_day",
    "rival_score", "voted",
]  # fmt: skip

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
    failed: list[Check]

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


def _not_clear(sigmas: float, T: np.ndarray, T_rival: np.ndarray) -> list[Check]:
    if sigmas >= _CLEAR_SIGMAS:
        return []
    apart = np.degrees(float(rotation_angle_rad(T @ inverse(T_rival))))
    sentence = f"frames do not agree: they fit {apart:.1f} deg apart nearly as well ({sigmas:.1f} sigmas)"
    return [Check(sentence, "witnesses_disagree")]


_UNIT = np.array([0.01] * 3 + [0.1] * 3)  # rad, m: steps of one are alike
# Half a cell of the grid, and the shift that moves a point 15 m away by as much. With it sigmas on the real day are
# what leaving out tenths of its scenes gives (0.08 / 0.06 deg against 0.08 / 0.08), over a whole cell 1.6 times that.
_STEP = np.array([0.0035] * 3 + [0.05] * 3)
_FIRST_WORTH = 30.0  # of a frame's mean log-likelihood, before the day tells it
_LEAST_CURVED = 0.02  # of the greatest curvature: flatter directions do not tell what the sum is worth
_CLIMB = 60  # steps at most
_VOTERS = 40  # frames for the comparison of candidates
APART_RAD = np.radians(0.5)  # a candidate farther away may lie on another peak


@dataclass(frozen=True, eq=False)
class JointFit:
    """Peak of prior and frames together, with its covariance (left twist [rad, m])."""

    T: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]  # of the frames alone
    frames: int


def voted(
    frames: Sequence[FrameEvidence], candidates: Sequence[Float[np.ndarray, "4 4"]]
) -> list[Float[np.ndarray, "4 4"]]:
    """The candidates, those first that frames spread over the day fit best."""
    voters = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, _VOTERS).astype(int))]
    fitting = np.array([scores(voters, T)[0].sum() for T in candidates])
    return [candidates[i] for i in np.argsort(-fitting, kind="stable")]


def climbed(
    frames: Sequence[FrameEvidence],
    T_start: Float[np.ndarray, "4 4"],
    T_prior: Float[np.ndarray, "4 4"],
    prior_covariance: Float[np.ndarray, "6 6"],
    worth: float | Float[np.ndarray, " E"] = _FIRST_WORTH,
) -> Float[np.ndarray, "4 4"]:
    """Peak above a start, of frames and prior together; `worth` weights each kind of evidence."""
    precision = np.linalg.inv(prior_covariance)

    def cost(step: np.ndarray) -> tuple[float, np.ndarray]:
        T = exp_se3(step * _UNIT) @ T_start
        value, gradient = scores(frames, T)
        off = log_se3(T @ inverse(T_prior))
        total = -float((worth * value.sum(0)).sum()) + 0.5 * float(off @ precision @ off)
        told = (np.reshape(worth, (-1, 1)) * gradient.sum(0)).sum(0)
        return total, (-told + precision @ off) * _UNIT

    found = minimize(cost, np.zeros(6), jac=True, method="L-BFGS-B", options={"maxiter": _CLIMB})
    return np.asarray(exp_se3(found.x * _UNIT) @ T_start)


def fit_of(
    frames: Sequence[FrameEvidence],
    block: Int[np.ndarray, " F"],
    T_start: Float[np.ndarray, "4 4"],
    T_prior: Float[np.ndarray, "4 4"],
    prior_covariance: Float[np.ndarray, "6 6"],
) -> JointFit:
    """Optimise from `T_start`, and estimate the peak's sigma; errors within a `block` (scene) are correlated."""
    T, worth = T_start, np.full(frames[0].kinds[-1] + 1, _FIRST_WORTH)
    for _ in range(2):
        T = climbed(frames, T, T_prior, prior_covariance, worth)
        H, gradient = _curvature(frames, T), scores(frames, T)[1]
        common = _worth(H.sum(0), _scatter(gradient.sum(1), block)) or _FIRST_WORTH
        own = np.array([_worth(H[e], _scatter(gradient[:, e], block)) for e in range(len(worth))])
        # Mean of each kind and of all: with few scenes one kind may seem certain by chance.
        share = np.sqrt(own / common)
        together = _scatter(np.einsum("e,fei->fi", share, gradient), block)
        # Kinds of one scene err together too.
        worth = share * _worth(np.einsum("e,eij->ij", share, H), together)
    return JointFit(T, _positive_part(np.einsum("e,eij->ij", worth, H)), len(frames))


def rival_score(
    frames: Sequence[FrameEvidence],
    block: Int[np.ndarray, " F"],
    T: Float[np.ndarray, "4 4"],
    T_rival: Float[np.ndarray, "4 4"],
) -> float:
    """By how many sigmas of the scenes' scatter frames prefer a pose to its rival; infinite where both are one peak."""
    if float(rotation_angle_rad(T @ inverse(T_rival))) < APART_RAD:
        return float("inf")
    better = (scores(frames, T)[0] - scores(frames, T_rival)[0]).sum(1)
    sums = np.bincount(np.unique(block, return_inverse=True)[1].ravel(), better)
    return float(better.sum() / (np.sqrt(np.square(sums - sums.mean()).sum()) + 1e-12))


def _worth(H: np.ndarray, J: np.ndarray) -> float:
    """Curvature over the gradient's scatter, mean over curved directions; 0 if there are none."""
    values, vectors = np.linalg.eigh(H * np.outer(_UNIT, _UNIT))
    curved = (values > _LEAST_CURVED * values[-1]) & (values > 0)
    scatter = np.einsum("ik,ij,jk->k", vectors, J * np.outer(_UNIT, _UNIT), vectors)
    if not curved.any() or scatter[curved].min() <= 0:
        return 0.0
    return float(1 / np.mean(scatter[curved] / values[curved]))


def _curvature(frames: Sequence[FrameEvidence], T: np.ndarray) -> Float[np.ndarray, "E 6 6"]:
    """Of the sum over frames, by kind of evidence; positive at a peak."""
    H = []
    for k, h in enumerate(_STEP):
        step = np.zeros(6)
        step[k] = h
        ahead, behind = (scores(frames, exp_se3(s) @ T)[1].sum(0) for s in (step, -step))
        H.append((behind - ahead) / (2 * h))
    found = np.stack(H, axis=1)
    return np.asarray((found + found.transpose(0, 2, 1)) / 2)


def _positive_part(M: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """Symmetric matrix without its negative eigenvalues, which carry no information."""
    values, vectors = np.linalg.eigh(M * np.outer(_UNIT, _UNIT))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(_UNIT, _UNIT))


def _scatter(gradient: Float[np.ndarray, "F 6"], block: Int[np.ndarray, " F"]) -> Float[np.ndarray, "6 6"]:
    """Covariance of the sum of frames' gradients, from scene to scene."""
    names, rows = np.unique(block, return_inverse=True)
    sums = np.zeros((len(names), 6))
    np.add.at(sums, rows.ravel(), gradient)
    sums -= sums.mean(0)
    return np.asarray(sums.T @ sums * len(names) / max(len(names) - 1, 1))

"""A pair of a vehicle-day and its clock from all frames together: candidates, vote, climb, covariance.

Camera-lidar by the classes of points in the image (`class_evidence`), lidar-radar by detections at the lidar's objects
(`radar_evidence`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from pipeline.learn.infer.aggregate import measured_estimate
from pipeline.learn.infer.class_evidence import FrameEvidence
from pipeline.learn.infer.radar_evidence import RadarEvidence
from pipeline.rig.estimates import Check, PairEstimate
from pipeline.rig.se3 import exp_se3, inverse, log_se3, rotation_angle_rad

__all__ = [
    "APART_RAD", "JOINT_BIAS_SIGMA", "Evidence", "Expected", "JointDay", "JointFit", "climbed", "fit_of", "fitted_day",
    "likelihood", "rival_score", "scores", "voted",
]  # fmt: skip

Evidence = FrameEvidence | RadarEvidence  # of one frame; points of the child, seen by the parent
_Place = tuple[np.ndarray, float]  # T of the pair, and the clock beyond what is expected [s]

_ROUNDS, _CONVERGED_RAD = 3, np.radians(0.1)  # of choosing points anew where the fit has turned
_CLEAR_SIGMAS = 3.0  # by which frames must prefer the fit to the best other place
# Sigma of what all frames err by alike, (bearing rotation [rad], translation [m]) in the parent's frame: chosen by how
# far days of several rigs err beyond their sigma. Ahead cameras err by 0.1 m, to one side: labels reach beyond their
# things. How far kinds of evidence disagree on a day was tried in its place: in the valleys of few scenes it explodes.
# A real radar's detections, which the road mirrors, lean by 4 deg to one side on every log (`FRAME_SIGMA`).
JOINT_BIAS_SIGMA = {
    "camera_lidar": np.array([*np.radians([0.05, 0.03, 0.1]), 0.015, 0.015, 0.15]),
    "lidar_radar": np.array([*np.radians([3.5, 0.2, 0.05]), 0.15, 0.07, 0.4]),
}


@dataclass(frozen=True, eq=False)
class Expected:
    """What is known before the day.

    Args:
        T: T_camera_lidar or T_lidar_radar.
        covariance: of its left twist [rad, m].
        clock_sigma_s: of one clock against the other, by which stamps may be apart besides `clock_s`.
        clock_s: what the stamps are expected to differ by: stamp_parent = stamp_child + dt.
    """

    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    clock_sigma_s: float
    clock_s: float = 0.0

    @property
    def precision(self) -> Float[np.ndarray, "7 7"]:
        """Inverse covariance of twist and clock."""
        out = np.zeros((7, 7))
        out[:6, :6], out[6, 6] = np.linalg.inv(self.covariance), self.clock_sigma_s**-2
        return out


@dataclass(frozen=True, eq=False)
class JointDay:
    """A pair on a day's frames with its fit, and checks that it failed."""

    pair: str
    frames: Sequence[Evidence]
    block: Int[np.ndarray, " F"]
    expected: Expected
    fit: JointFit
    failed: list[Check]

    def estimate(self, rows: Bool[np.ndarray, " F"] | None = None) -> PairEstimate:
        """Of the pair, by all frames or by some."""
        fit, expected = self.fit, self.expected
        if rows is not None:
            some = [frame for frame, kept in zip(self.frames, rows, strict=True) if kept]
            fit = fit_of(some, self.block[rows], (fit.T, fit.dt_s), expected)
        found = measured_estimate(
            self.pair, fit.T, fit.of_pose(expected), JOINT_BIAS_SIGMA[self.pair], expected.T, expected.covariance,
            fit.frames,
        )  # fmt: skip
        sigma_s = float(np.sqrt(np.linalg.inv(fit.information + expected.precision)[6, 6]))
        clock_s = expected.clock_s
        return replace(
            found, time_offset_s=clock_s + fit.dt_s, time_offset_sigma_s=sigma_s, time_offset_prior_s=clock_s
        )


def fitted_day(
    pair: str, evidence: Callable[[np.ndarray], Sequence[Evidence]], block: Int[np.ndarray, " F"],
    candidates: Sequence[Float[np.ndarray, "4 4"]], expected: Expected,
) -> JointDay | None:  # fmt: skip
    """Vote, optimise and select points again until the fit is stable; None if the network has no evidence.

    Args:
        evidence: of all frames, points chosen through a pose.
        candidates: poses that rounds and single frames found; the first ones are on no better footing than
            others.
    """
    frames = evidence(candidates[-1])
    if not frames:
        return None
    ordered = voted(frames, candidates)
    T, dt_s = climbed(frames, (ordered[0], 0.0), expected)
    others = [C for C in ordered if float(rotation_angle_rad(C @ inverse(T))) > APART_RAD]
    failed = []
    if others:
        rival = climbed(frames, (others[0], dt_s), expected)
        clear = rival_score(frames, block, (T, dt_s), rival)
        failed = _not_clear(abs(clear), T, rival[0])
        T, dt_s = (T, dt_s) if clear > 0 else rival
    for _ in range(_ROUNDS):
        before, frames = T, evidence(T)
        fit = fit_of(frames, block, (T, dt_s), expected)
        T, dt_s = fit.T, fit.dt_s
        if float(rotation_angle_rad(T @ inverse(before))) < _CONVERGED_RAD:
            break
    return JointDay(pair, frames, block, expected, fit, failed)


def _not_clear(sigmas: float, T: np.ndarray, T_rival: np.ndarray) -> list[Check]:
    if sigmas >= _CLEAR_SIGMAS:
        return []
    apart = np.degrees(float(rotation_angle_rad(T @ inverse(T_rival))))
    sentence = f"frames disagree: a pose {apart:.1f} deg away fits nearly as well ({sigmas:.1f} sigmas)"
    return [Check(sentence, "witnesses_disagree")]


# Twist, then the clock: rad, m, s. Steps of one are alike.
_UNIT = np.array([0.01] * 3 + [0.1] * 3 + [0.01])
# Half a cell of the grid, and the shift that moves a point 15 m away by as much. With it sigmas on the real day are
# what leaving out tenths of its scenes gives (0.08 / 0.06 deg against 0.08 / 0.08), over a whole cell 1.6 times that.
_STEP = np.array([0.0035] * 3 + [0.05] * 3 + [0.005])
_FIRST_WORTH = 30.0  # of a frame's mean log-likelihood, before the day tells it
_LEAST_CURVED = 0.02  # of the greatest curvature: flatter directions do not tell what the sum is worth
_CLIMB = 60  # steps at most
_VOTERS = 40  # frames for the comparison of candidates
APART_RAD = np.radians(0.5)  # a candidate farther away may lie on another peak


@dataclass(frozen=True, eq=False)
class JointFit:
    """Peak of prior and frames together, with its covariance (left twist [rad, m], clock [s])."""

    T: Float[np.ndarray, "4 4"]
    dt_s: float  # of the clock beyond what is expected
    information: Float[np.ndarray, "7 7"]  # of the frames alone
    frames: int

    def of_pose(self, expected: Expected) -> Float[np.ndarray, "6 6"]:
        """Information of the frames on the pose, with the clock as uncertain as it is."""
        H, h = self.information[:6, :6], self.information[:6, 6]
        return np.asarray(H - np.outer(h, h) / (self.information[6, 6] + expected.precision[6, 6]))


def scores(
    frames: Sequence[Evidence], T: Float[np.ndarray, "4 4"], dt_s: float = 0.0
) -> tuple[Float[np.ndarray, "F E"], Float[np.ndarray, "F E 7"]]:
    """Mean log-likelihood of each frame's points by kind of evidence, and its gradient.

    The gradient is by a left twist and by `dt_s` (per rad, per m, per s): stamp_parent = stamp_child + dt. Points are
    where a standing world has them when the parent measures. All frames have the same kinds.
    """
    travel, late_s = np.stack([f.travel for f in frames]), np.array([dt_s - f.lag_s for f in frames])
    T_late = T @ exp_se3(late_s[:, None] * travel)
    value, by_pose = map(np.stack, zip(*(f.score(T_late[i]) for i, f in enumerate(frames)), strict=True))
    turn, shift = np.einsum("fij,fkj->kfi", T_late[:, :3, :3], travel.reshape(-1, 2, 3))
    by_clock = np.concatenate([turn, shift + np.cross(T_late[:, :3, 3], turn)], axis=1)
    return value, np.concatenate([by_pose, np.einsum("fei,fi->fe", by_pose, by_clock)[..., None]], axis=2)


def voted(
    frames: Sequence[Evidence], candidates: Sequence[Float[np.ndarray, "4 4"]]
) -> list[Float[np.ndarray, "4 4"]]:
    """The candidates, those first that frames spread over the day fit best."""
    voters = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, _VOTERS).astype(int))]
    return [candidates[i] for i in np.argsort(-_fitting(voters, candidates), kind="stable")]


def likelihood(
    looks: Sequence[Evidence], candidates: Sequence[Float[np.ndarray, "4 4"]]
) -> Float[np.ndarray, " C"]:
    """Relative likelihood of poses by one frame, whose points were chosen in several ways; its sum is 1."""
    fitting = _FIRST_WORTH * _fitting(looks, candidates) / len(looks)
    relative = np.exp(fitting - fitting.max())
    return np.asarray(relative / relative.sum())


def _fitting(
    frames: Sequence[Evidence], candidates: Sequence[Float[np.ndarray, "4 4"]]
) -> Float[np.ndarray, " C"]:
    return np.array([scores(frames, T)[0].sum() for T in candidates])


def climbed(
    frames: Sequence[Evidence], start: _Place, expected: Expected,
    worth: float | Float[np.ndarray, " E"] = _FIRST_WORTH,
) -> _Place:  # fmt: skip
    """Peak above a start, of frames and prior together; `worth` weights each kind of evidence."""
    precision = expected.precision

    def at(step: np.ndarray) -> _Place:
        x = step * _UNIT
        return exp_se3(x[:6]) @ start[0], start[1] + float(x[6])

    def cost(step: np.ndarray) -> tuple[float, np.ndarray]:
        T, dt_s = at(step)
        value, gradient = scores(frames, T, dt_s)
        off = np.append(log_se3(T @ inverse(expected.T)), dt_s)
        total = -float((worth * value.sum(0)).sum()) + 0.5 * float(off @ precision @ off)
        told = (np.reshape(worth, (-1, 1)) * gradient.sum(0)).sum(0)
        return total, (-told + precision @ off) * _UNIT

    return at(minimize(cost, np.zeros(7), jac=True, method="L-BFGS-B", options={"maxiter": _CLIMB}).x)


def fit_of(
    frames: Sequence[Evidence], block: Int[np.ndarray, " F"], start: _Place, expected: Expected
) -> JointFit:
    """Optimise from a start, and estimate the peak's sigma; errors within a `block` (scene) are correlated."""
    at, worth = start, np.full(frames[0].kinds[-1] + 1, _FIRST_WORTH)
    for _ in range(2):
        at = climbed(frames, at, expected, worth)
        H, gradient = _curvature(frames, at), scores(frames, *at)[1]
        common = _worth(H.sum(0), _scatter(gradient.sum(1), block)) or _FIRST_WORTH
        own = np.array([_worth(H[e], _scatter(gradient[:, e], block)) for e in range(len(worth))])
        # Mean of each kind and of all: with few scenes one kind may seem certain by chance.
        share = np.sqrt(own / common)
        together = _scatter(np.einsum("e,fei->fi", share, gradient), block)
        # Kinds of one scene err together too.
        worth = share * _worth(np.einsum("e,eij->ij", share, H), together)
    return JointFit(*at, _positive_part(np.einsum("e,eij->ij", worth, H)), len(frames))


def rival_score(frames: Sequence[Evidence], block: np.ndarray, place: _Place, rival: _Place) -> float:
    """By how many sigmas of the scenes' scatter frames prefer a pose to its rival; infinite where both are one peak."""
    if float(rotation_angle_rad(place[0] @ inverse(rival[0]))) < APART_RAD:
        return float("inf")
    better = (scores(frames, *place)[0] - scores(frames, *rival)[0]).sum(1)
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


def _curvature(frames: Sequence[Evidence], place: _Place) -> Float[np.ndarray, "E 7 7"]:
    """Of the sum over frames, by kind of evidence; positive at a peak."""
    (T, dt_s), H = place, []
    for k, h in enumerate(_STEP):
        step = np.zeros(7)
        step[k] = h
        ahead, behind = (
            scores(frames, exp_se3(s[:6]) @ T, dt_s + float(s[6]))[1].sum(0) for s in (step, -step)
        )
        H.append((behind - ahead) / (2 * h))
    found = np.stack(H, axis=1)
    return np.asarray((found + found.transpose(0, 2, 1)) / 2)


def _positive_part(M: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P P"]:
    """Symmetric matrix without its negative eigenvalues, which carry no information."""
    values, vectors = np.linalg.eigh(M * np.outer(_UNIT, _UNIT))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(_UNIT, _UNIT))


def _scatter(gradient: Float[np.ndarray, "F P"], block: Int[np.ndarray, " F"]) -> Float[np.ndarray, "P P"]:
    """Covariance of the sum of frames' gradients, from scene to scene."""
    names, rows = np.unique(block, return_inverse=True)
    sums = np.zeros((len(names), gradient.shape[1]))
    np.add.at(sums, rows.ravel(), gradient)
    sums -= sums.mean(0)
    return np.asarray(sums.T @ sums * len(names) / max(len(names) - 1, 1))

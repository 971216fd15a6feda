"""One pair's estimate with its covariance from a network's answers on single frames.

A network that has learned nothing returns its guess. So every frame has a guess of its own, and a robust regression
separates the part of the answers that comes from the frame: answer = H x + (1 - H) guess + noise, with the gain H = 1
where the network determines a degree of freedom, 0 where it repeats its guess. The day is the linear-Gaussian update
of the prior by H x.

Twists are (bearing rotation, translation) about a common centre. The bearing rotation turns the directions to points
15 to 40 m ahead as the twist does, by least squares: a network that aligns directions compensates a wrong translation
by a rotation, and its bearing rotation is right all the same. So H is nearly diagonal, and few frames suffice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.rig.estimates import PairEstimate, common_of
from pipeline.rig.se3 import exp_se3, from_spherical, hat, inverse, log_se3, transform_points

__all__ = ["BIAS_SIGMA", "Answers", "day_estimate", "mean_answer", "measured_estimate", "twists_about"]

OBSERVABLE = 0.5  # the day at least halved the variance, as in all methods
_RESAMPLES = 200
_ROUNDS = 12  # of re-weighting
_LEAST_GAIN = 0.2  # ignore a degree of freedom with a gain below it: dividing by the gain amplifies noise
_FARTHEST_SIGMAS = 3.0  # of the prior: how far from it guesses may be centred
_IGNORED = 1e6  # variance [rad^2, m^2] of a degree of freedom that is ignored
_TUKEY = 4.7  # robust sigmas from which on an answer does not count
# Prior of the regression's coefficients: mean 0, standard deviation 1 for a degree of freedom's own guess and 0.1 for
# the guess of another one, a radian counted as a shift of _DISTANCE_M. Without it, noise in the coefficients carries a
# radar's roll, which no day determines, into its elevation.
_DISTANCE_M = 15.0
# Errors of single frames in scatters of where searches over the prior end, where those end apart: 2.5 to 5 on the real
# car's frames that turn a camera by degrees (2, 20, 50), which had called themselves known to .5 to 1.4 deg.
ENDS_FACTOR = 3.0
# What single photographs err by beside what networks predict, measured on every other of the frames; of the radar's
# roll and elevation nearly all: detections that the road mirrors draw each frame down alike. Stated and not weighed:
# simulated frames know better. In parent axes, as BIAS_SIGMA.
FRAME_SIGMA: dict[str, tuple[float, ...]] = {
    "camera_lidar": (*np.radians([0.5, 0.3, 0.3]), 0.0, 0.0, 0.0),
    "camera_radar": (*np.radians([2.5, 0.0, 3.5]), 0.0, 0.0, 0.0),
    "lidar_radar": (*np.radians([3.5, 3.0, 0.3]), 0.0, 0.0, 0.0),
}
_UNIT = np.array([1.0] * 3 + [_DISTANCE_M] * 3)
_OWN_GAIN, _OTHER_GAIN = 1.0, 0.1
# Directions [deg] and distances [m] of the points that define the bearing rotation, in the child's frame: where all
# three sensors see.
_SEEN_AZIMUTH_DEG, _SEEN_ELEVATION_DEG = (-25.0, -12.0, 0.0, 12.0, 25.0), (-6.0, 0.0, 3.0)
_SEEN_M = (15.0, 25.0, 40.0)
# Sigma of a network's bias, which averaging over frames does not lower: (bearing rotation [rad], translation [m]) in
# parent axes, a camera's (elevation, azimuth, roll), a lidar's (roll, elevation, azimuth). These hold for networks
# whose bias was not measured (see `OnnxNetwork.bias_sigma`). Their translations are not used: some such networks put
# the lidar 0.3 m too far ahead.
BIAS_SIGMA: dict[str, tuple[float, ...]] = {
    "camera_lidar": (*np.radians([0.06, 0.05, 0.1]), 0.4, 0.4, 0.4),
    "camera_radar": (*np.radians([0.2, 0.1, 0.5]), 0.4, 0.4, 0.4),
    "lidar_radar": (*np.radians([0.5, 0.2, 0.1]), 0.4, 0.4, 0.4),
}


@dataclass(frozen=True, eq=False)
class Answers:
    """One pair on N frames, twists (rotation vector [rad], translation [m]) on the left of the centre."""

    T_centre: Float[np.ndarray, "4 4"]
    guess: Float[np.ndarray, "N 6"]
    answer: Float[np.ndarray, "N 6"]
    variance: Float[np.ndarray, "N 6"]  # as the network predicts it
    block: Int[np.ndarray, " N"]  # frames of one block see the same things
    frames: int  # different ones among the N
    bias_sigma: Float[np.ndarray, " 6"]  # of all answers, (bearing rotation [rad], translation [m])
    # Where searches that started all over the prior ended, about the centre; None: nobody looked (days have frames).
    ends: Float[np.ndarray, "M 6"] | None = None
    ends_worth: Float[np.ndarray, " M"] | None = None  # their weights, of sum 1

    @property
    def ends_covariance(self) -> Float[np.ndarray, "3 3"]:
        """Of the rotations at the ends; 0 where nobody looked."""
        if self.ends is None:
            return np.zeros((3, 3))
        unbiased = len(self.ends) / (len(self.ends) - 1)
        return np.asarray(unbiased * np.cov(self.ends[:, :3].T, aweights=self.ends_worth, ddof=0))


def twists_about(
    T_centre: Float[np.ndarray, "4 4"], T: Float[np.ndarray, "N 4 4"]
) -> Float[np.ndarray, "N 6"]:
    """Xi with T = exp(xi) T_centre."""
    return log_se3(T @ inverse(T_centre))


def day_estimate(
    pair: str, answers: Answers, T_prior: Float[np.ndarray, "4 4"], prior_covariance: Float[np.ndarray, "6 6"],
    rng: np.random.Generator, unobservable: Bool[np.ndarray, " 6"] | None = None,
) -> PairEstimate:  # fmt: skip
    """Transform and covariance of a pair from the prior and all answers.

    Args:
        unobservable: degrees of freedom that the sensors cannot determine for any answer of the network:
            those of elevation with a radar that does not measure it.
    """
    S = _bearing_of_twist(answers.T_centre)
    twist_of_bearing = np.linalg.inv(S)
    ends = None if answers.ends is None else answers.ends @ S.T
    answers = replace(answers, guess=answers.guess @ S.T, answer=answers.answer @ S.T, ends=ends)
    fit = _robust_regression(answers)
    draws = _bootstrap(answers, fit, rng)
    mean, gain = fit.coefficients[0], fit.coefficients[1:].T
    m0 = S @ log_se3(T_prior @ inverse(answers.T_centre))
    P = S @ prior_covariance @ S.T
    H = np.eye(6) - gain
    blind = np.zeros(6, bool) if unobservable is None else unobservable
    ignored = blind | (np.diag(H) < _LEAST_GAIN)
    spread = _spread(answers, draws, ignored)
    gain_variance = draws[:, 1:].transpose(0, 2, 1).var(axis=0)
    x, covariance, R = m0, P, spread
    for _ in range(3):  # errors of H count by how far the truth may lie
        R = spread + np.diag(gain_variance @ (np.diag(covariance) + x * x))
        x, covariance = _update(m0, P, H, R, mean)
    stated = np.zeros((6, 6)) if answers.ends is None else np.diag(np.square(FRAME_SIGMA[pair]))
    weighed, observability = (
        1 - np.diag(twist_of_bearing @ C @ twist_of_bearing.T) / np.diag(prior_covariance)
        for C in (covariance, covariance + stated)
    )
    observability = np.clip(observability, 0.0, 1.0)
    observable = observability >= OBSERVABLE
    if answers.ends is not None and (weighed < OBSERVABLE)[:3][~blind[:3]].any():
        observable[:] = False  # searches end apart: an answer is right or wrong as a whole
    if not observable.all():
        x, covariance = _update(m0, P, H, R, mean, keep=~observable)
    covariance = covariance + np.where(np.outer(observable, observable), stated, 0.0)
    covariance = twist_of_bearing @ covariance @ twist_of_bearing.T
    covariance = (covariance + covariance.T) / 2
    bias = twist_of_bearing @ np.diag(np.square(answers.bias_sigma)) @ twist_of_bearing.T
    return PairEstimate(
        pair, exp_se3(twist_of_bearing @ x) @ answers.T_centre, covariance, observability, observable,
        answers.frames, diagnostics=_diagnostics(fit, gain, answers),
        common_covariance=common_of(covariance, prior_covariance, bias),
    )  # fmt: skip


def measured_estimate(
    pair: str, T: Float[np.ndarray, "4 4"], information: Float[np.ndarray, "6 6"], bias_sigma: Float[np.ndarray, " 6"],
    T_prior: Float[np.ndarray, "4 4"], prior_covariance: Float[np.ndarray, "6 6"], frames: int,
) -> PairEstimate:  # fmt: skip
    """Estimate of a pair from a fit of all frames under the prior, with an error common to all frames.

    Args:
        T: the peak of frames and prior together.
        information: of the frames alone, left twist; may be singular.
        bias_sigma: sigmas of the error common to all frames, (bearing rotation [rad], translation [m]).
    """
    S = _bearing_of_twist(T)
    back = np.linalg.inv(S)
    P, bias = S @ prior_covariance @ S.T, np.diag(np.square(bias_sigma))
    precision, own = np.linalg.inv(P), back.T @ information @ back
    m0 = S @ log_se3(T_prior @ inverse(T))
    # (own^-1 + bias)^-1 and what it says, without the inverse of what may be flat; at the peak own z = -precision m0.
    share = np.linalg.inv(np.eye(6) + own @ bias)
    told, said = share @ own, share @ -precision @ m0
    found = np.linalg.inv(told + precision)
    observability = np.clip(1 - np.diag(back @ found @ back.T) / np.diag(prior_covariance), 0.0, 1.0)
    observable = observability >= OBSERVABLE
    # The others are considered, not updated (Schmidt-Kalman).
    gain = np.where(observable[:, None], found, 0.0)
    keep = np.eye(6) - gain @ told
    x = back @ (m0 + gain @ (said - told @ m0))
    covariance = back @ (keep @ P @ keep.T + gain @ told @ gain.T) @ back.T
    covariance = (covariance + covariance.T) / 2
    return PairEstimate(
        pair, exp_se3(x) @ T, covariance, observability, observable, frames,
        common_covariance=common_of(covariance, prior_covariance, back @ bias @ back.T),
    )  # fmt: skip


def mean_answer(
    answers: Answers, T_prior: Float[np.ndarray, "4 4"], prior_covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "4 4"]:
    """The answers' mean without the part due to their guesses; at most 3 prior sigmas from the prior."""
    fit = _robust_regression(answers)
    from_prior = log_se3(exp_se3(fit.coefficients[0]) @ answers.T_centre @ inverse(T_prior))
    limit = _FARTHEST_SIGMAS * np.sqrt(np.diag(prior_covariance))
    return exp_se3(np.clip(from_prior, -limit, limit)) @ T_prior


def _bearing_of_twist(T_centre: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """Matrix from a small twist to (bearing rotation, translation); see the module's docstring."""
    azimuth, elevation, distance = np.meshgrid(
        np.radians(_SEEN_AZIMUTH_DEG), np.radians(_SEEN_ELEVATION_DEG), _SEEN_M, indexing="ij"
    )
    seen = from_spherical(np.stack([azimuth.ravel(), elevation.ravel(), distance.ravel()], axis=1))
    points = transform_points(T_centre, seen)
    length = np.linalg.norm(points, axis=1)[:, None, None]
    u = points[:, :, None] / length
    by_turn = -hat(u[:, :, 0])
    by_shift = (np.eye(3) - u @ u.transpose(0, 2, 1)) / length
    S = np.eye(6)
    S[:3, 3:] = np.linalg.lstsq(by_turn.reshape(-1, 3), by_shift.reshape(-1, 3), rcond=None)[0]
    return S


def _spread(answers: Answers, draws: np.ndarray, ignored: np.ndarray) -> Float[np.ndarray, "6 6"]:
    """Covariance of the mean answer: bootstrap, at least the network's prediction, plus the bias."""
    spread = np.cov(draws[:, 0].T)
    predicted = np.median(answers.variance, axis=0) / answers.frames
    spread += np.diag(np.maximum(predicted - np.diag(spread), 0.0) + np.square(answers.bias_sigma))
    spread[:3, :3] += ENDS_FACTOR**2 * answers.ends_covariance
    return np.asarray(spread + np.diag(np.where(ignored, _IGNORED, 0.0)))


@dataclass(frozen=True, eq=False)
class _Fit:
    coefficients: Float[np.ndarray, "7 6"]  # row 0: at guess 0; rows 1..6: by guess
    weight: Float[np.ndarray, "N 6"]
    scatter: Float[np.ndarray, " 6"]  # robust sd of one answer


def _robust_regression(answers: Answers) -> _Fit:
    """Least squares, re-weighted by the predicted variances and by Tukey's function of the residuals."""
    relative = answers.variance / np.median(answers.variance, axis=0)
    # Networks understate their variance more often than they overstate it: the lower limit is the tighter one.
    trust = 1 / np.clip(relative, 0.2, 20.0)
    weight = trust.copy()
    scatter = answers.answer.std(axis=0) + 1e-9
    for _ in range(_ROUNDS):
        B = _solve(answers.guess, answers.answer, weight, scatter)
        residual = answers.answer - B[0] - answers.guess @ B[1:]
        scaled = residual * np.sqrt(trust)
        scatter = 1.4826 * np.median(np.abs(scaled - np.median(scaled, axis=0)), axis=0) + 1e-9
        u = np.minimum(np.abs(scaled) / (_TUKEY * scatter), 1.0)
        # An answer is right or wrong as a whole: its worst degree of freedom decides.
        weight = trust * ((1 - u * u) ** 2).min(axis=1, keepdims=True)
    return _Fit(B, weight, scatter)


def _solve(
    guess: np.ndarray, answer: np.ndarray, weight: np.ndarray, scatter: np.ndarray
) -> Float[np.ndarray, "7 6"]:
    """Weighted least squares by column of the answer, with a prior on the gains."""
    A = np.column_stack([np.ones(len(guess)), guess])
    B = np.empty((7, 6))
    for j in range(6):
        w = weight[:, j]
        usual = np.where(np.arange(6) == j, _OWN_GAIN, _OTHER_GAIN) * _UNIT[j] / _UNIT
        ridge = np.concatenate([[0.0], (scatter[j] / usual) ** 2])
        normal = A.T @ (w[:, None] * A) + np.diag(ridge + 1e-15)
        B[:, j] = np.linalg.solve(normal, A.T @ (w * answer[:, j]))
    return B


def _bootstrap(answers: Answers, fit: _Fit, rng: np.random.Generator) -> Float[np.ndarray, "S 7 6"]:
    """Coefficients of resampled days: blocks drawn with replacement."""
    blocks = [np.flatnonzero(answers.block == b) for b in np.unique(answers.block)]
    draws = np.empty((_RESAMPLES, 7, 6))
    for s in range(_RESAMPLES):
        rows = np.concatenate([blocks[b] for b in rng.integers(len(blocks), size=len(blocks))])
        draws[s] = _solve(answers.guess[rows], answers.answer[rows], fit.weight[rows], fit.scatter)
    return draws


def _update(
    m0: np.ndarray, P: np.ndarray, H: np.ndarray, R: np.ndarray, z: np.ndarray,
    keep: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Kalman update of mean and covariance; rows of `keep` are considered, not updated (Schmidt-Kalman)."""
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    if keep is not None:
        K[keep] = 0.0
    I_KH = np.eye(6) - K @ H
    return m0 + K @ (z - H @ m0), I_KH @ P @ I_KH.T + K @ R @ K.T


def _diagnostics(fit: _Fit, gain: np.ndarray, answers: Answers) -> dict[str, float]:
    """Scatter of one frame's answers, the share of a guess that answers repeat, and how many answers are outliers."""
    return {
        "ends_apart_deg": float(np.degrees(np.sqrt(np.trace(answers.ends_covariance)))),
        "frame_scatter_deg": float(np.degrees(np.linalg.norm(fit.scatter[:3]))),
        "frame_scatter_m": float(np.linalg.norm(fit.scatter[3:])),
        "repeated_rotation": float(np.abs(np.diag(gain)[:3]).max()),
        "repeated_translation": float(np.abs(np.diag(gain)[3:]).max()),
        "answers": float(len(answers.answer)),
        "answers_outlying": float(np.sum(fit.weight.max(axis=1) <= 0)),
    }

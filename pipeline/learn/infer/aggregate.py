"""From a network's answers on single frames to one pair's estimate with an honest covariance.

A network that has learned nothing repeats its guess, and all its answers agree. So no frame is asked at the same guess:
guesses are scattered on purpose, and a robust regression separates what answers owe to the frame from what they owe to
the guess:

    answer_i = H x + (1 - H) guess_i + noise_i,

about a common centre, x the truth's. H is what the network determines, degree of freedom by degree of freedom and in
combination. The day's answer is then the linear-Gaussian update of the prior by the measurement H x: where H is 0 the
prior stays, value and sigma.

x, guesses and answers are (sight, translation): the turn that would move what stands 15 to 40 m ahead as the twist
does, and the twist's translation. Who aligns two pictures by a wrong translation turns the pose by shift over
distance, and yet sees things where they are: sight does not depend on the guessed translation, so H is nearly diagonal
and hardly anything has to be learned from few noisy frames. A prior's translation that stays takes its rotation along.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.extrinsics.estimates import PairEstimate
from pipeline.geometry.se3 import exp_se3, hat, inverse, log_se3, transform_points
from pipeline.geometry.spherical import from_spherical

__all__ = ["BIAS_SIGMA", "Answers", "day_estimate", "mean_answer", "shared_bias", "twists_about"]

OBSERVABLE = 0.5  # the day at least halved the variance, as in all methods
_RESAMPLES = 200
_ROUNDS = 12  # of re-weighting
# Who repeats four fifths of a guess, or drives it further off, is not listened to: what is left, divided by a fifth and
# less, would be an opinion made of how the guess was repeated.
_LEAST_GAIN = 0.2
_FARTHEST_SIGMAS = 3.0
_NOTHING = 1e6  # variance of an answer that means nothing
_TUKEY = 4.7  # robust sigmas from which on an answer does not count
# Gains before any frame is seen are 0 give or take 1 of a degree of freedom's own guess, and give or take a tenth of
# another's, where a radian counts as much as a shift of a usual distance. Without that a radar's roll, which no day
# tells, leaks into its elevation by gains that are noise.
_DISTANCE_M = 15.0
_UNIT = np.array([1.0] * 3 + [_DISTANCE_M] * 3)
_OWN_GAIN, _OTHER_GAIN = 1.0, 0.1
# Directions [deg] and distances [m] of what sight is about, in the child's frame: what all three sensors see.
_SEEN_AZIMUTH_DEG, _SEEN_ELEVATION_DEG = (-25.0, -12.0, 0.0, 12.0, 25.0), (-6.0, 0.0, 3.0)
_SEEN_M = (15.0, 25.0, 40.0)
# What averaging does not lower: where a network's answers differ from H x on every frame alike. Sight and translation
# in parent axes: a camera's are (elevation, azimuth, roll), a lidar's (roll, elevation, azimuth). Of networks that
# nobody measured (`OnnxNetwork.bias_sigma`) no translation is believed: some put lidars .3 m too far ahead.
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
    bias_sigma: Float[np.ndarray, " 6"] | None = None  # (sight, translation); None: BIAS_SIGMA of the pair


def twists_about(
    T_centre: Float[np.ndarray, "4 4"], T: Float[np.ndarray, "N 4 4"]
) -> Float[np.ndarray, "N 6"]:
    """Xi with T = exp(xi) T_centre."""
    return log_se3(T @ inverse(T_centre))


def day_estimate(
    pair: str,
    answers: Answers,
    T_prior: Float[np.ndarray, "4 4"],
    prior_covariance: Float[np.ndarray, "6 6"],
    rng: np.random.Generator,
    blind: Bool[np.ndarray, " 6"] | None = None,
) -> PairEstimate:
    """The pair's transform and covariance from the prior and all answers.

    Args:
        pair: camera_lidar, camera_radar or lidar_radar.
        answers: at scattered guesses.
        T_prior: the prior.
        prior_covariance: its covariance, left perturbation.
        rng: draws the bootstrap's blocks.
        blind: degrees of freedom whose answers mean nothing, whatever the network says: a flat radar's elevations.
    """
    S = _sight_of_twist(answers.T_centre)
    twist_of_sight = np.linalg.inv(S)
    answers = replace(answers, guess=answers.guess @ S.T, answer=answers.answer @ S.T)
    fit = _robust_regression(answers)
    draws = _bootstrap(answers, fit, rng)
    mean, gain = fit.coefficients[0], fit.coefficients[1:].T
    m0 = S @ log_se3(T_prior @ inverse(answers.T_centre))
    P = S @ prior_covariance @ S.T
    H = np.eye(6) - gain
    deaf = np.diag(H) < _LEAST_GAIN
    spread = _spread(pair, answers, draws, deaf if blind is None else deaf | blind)
    gain_variance = draws[:, 1:].transpose(0, 2, 1).var(axis=0)
    x, covariance, R = m0, P, spread
    for _ in range(3):
        # H is known only so well: what that costs depends on how far the truth may lie from the centre.
        R = spread + np.diag(gain_variance @ (np.diag(covariance) + x * x))
        x, covariance = _update(m0, P, H, R, mean)
    left = np.diag(twist_of_sight @ covariance @ twist_of_sight.T)
    observability = np.clip(1 - left / np.diag(prior_covariance), 0.0, 1.0)
    observable = observability >= OBSERVABLE
    if not observable.all():
        x, covariance = _update(m0, P, H, R, mean, keep=~observable)
    x, covariance = twist_of_sight @ x, twist_of_sight @ covariance @ twist_of_sight.T
    return PairEstimate(
        pair,
        exp_se3(x) @ answers.T_centre,
        (covariance + covariance.T) / 2,
        observability,
        observable,
        answers.frames,
        diagnostics=_diagnostics(fit, gain, answers),
    )


def shared_bias(answers: Answers, T_true: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
    """By what all answers differ from H x where x is known: what `bias_sigma` should allow for ([rad], [m])."""
    S = _sight_of_twist(answers.T_centre)
    fit = _robust_regression(replace(answers, guess=answers.guess @ S.T, answer=answers.answer @ S.T))
    H = np.eye(6) - fit.coefficients[1:].T
    return np.asarray(fit.coefficients[0] - H @ S @ log_se3(T_true @ inverse(answers.T_centre)))


def mean_answer(
    answers: Answers, T_prior: Float[np.ndarray, "4 4"], prior_covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "4 4"]:
    """Where the answers point on the whole, whatever they owe to their guesses; 3 prior sigmas from it at most."""
    fit = _robust_regression(answers)
    from_prior = log_se3(exp_se3(fit.coefficients[0]) @ answers.T_centre @ inverse(T_prior))
    limit = _FARTHEST_SIGMAS * np.sqrt(np.diag(prior_covariance))
    return exp_se3(np.clip(from_prior, -limit, limit)) @ T_prior


def _sight_of_twist(T_centre: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """(sight, translation) of a small twist: sight is the turn that moves directions as the twist does, at best."""
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


def _spread(pair: str, answers: Answers, draws: np.ndarray, blind: np.ndarray) -> Float[np.ndarray, "6 6"]:
    """Covariance of the mean answer: what blocks say, no less than the network says itself, and the bias."""
    spread = np.cov(draws[:, 0].T)
    claimed = np.median(answers.variance, axis=0) / answers.frames
    bias = BIAS_SIGMA[pair] if answers.bias_sigma is None else answers.bias_sigma
    spread += np.diag(np.maximum(claimed - np.diag(spread), 0.0) + np.square(bias))
    return np.asarray(spread + np.diag(np.where(blind, _NOTHING, 0.0)))


@dataclass(frozen=True, eq=False)
class _Fit:
    coefficients: Float[np.ndarray, "7 6"]  # row 0: at guess 0; rows 1..6: by guess
    weight: Float[np.ndarray, "N 6"]
    scatter: Float[np.ndarray, " 6"]  # robust sd of one answer


def _robust_regression(answers: Answers) -> _Fit:
    """Weights from predicted variances, and Tukey's from the residuals, until they settle."""
    relative = answers.variance / np.median(answers.variance, axis=0)
    trust = 1 / np.clip(
        relative, 0.2, 20.0
    )  # networks overstate their confidence more often than their doubt
    weight = trust.copy()
    scatter = answers.answer.std(axis=0) + 1e-9
    for _ in range(_ROUNDS):
        B = _solve(answers.guess, answers.answer, weight, scatter)
        residual = answers.answer - _design(answers.guess) @ B
        scaled = residual * np.sqrt(trust)
        scatter = 1.4826 * np.median(np.abs(scaled - np.median(scaled, axis=0)), axis=0) + 1e-9
        u = np.minimum(np.abs(scaled) / (_TUKEY * scatter), 1.0)
        # An answer is right or wrong as a whole: its worst degree of freedom decides.
        weight = trust * ((1 - u * u) ** 2).min(axis=1, keepdims=True)
    return _Fit(B, weight, scatter)


def _design(guess: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(guess)), guess])


def _solve(
    guess: np.ndarray, answer: np.ndarray, weight: np.ndarray, scatter: np.ndarray
) -> Float[np.ndarray, "7 6"]:
    """Weighted least squares by column of the answer, with a prior on the gains."""
    A = _design(guess)
    B = np.empty((7, 6))
    for j in range(6):
        w = weight[:, j]
        usual = np.where(np.arange(6) == j, _OWN_GAIN, _OTHER_GAIN) * _UNIT[j] / _UNIT
        ridge = np.concatenate([[0.0], (scatter[j] / usual) ** 2])
        normal = A.T @ (w[:, None] * A) + np.diag(ridge + 1e-15)
        B[:, j] = np.linalg.solve(normal, A.T @ (w * answer[:, j]))
    return B


def _bootstrap(answers: Answers, fit: _Fit, rng: np.random.Generator) -> Float[np.ndarray, "S 7 6"]:
    """Coefficients of days made of the same blocks drawn with replacement."""
    blocks = [np.flatnonzero(answers.block == b) for b in np.unique(answers.block)]
    draws = np.empty((_RESAMPLES, 7, 6))
    for s in range(_RESAMPLES):
        rows = np.concatenate([blocks[b] for b in rng.integers(len(blocks), size=len(blocks))])
        draws[s] = _solve(answers.guess[rows], answers.answer[rows], fit.weight[rows], fit.scatter)
    return draws


def _update(
    m0: np.ndarray,
    P: np.ndarray,
    H: np.ndarray,
    R: np.ndarray,
    z: np.ndarray,
    keep: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Kalman's update; rows of `keep` stay as they are and are considered with the sigma that they have (Schmidt)."""
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    if keep is not None:
        K[keep] = 0.0
    I_KH = np.eye(6) - K @ H
    return m0 + K @ (z - H @ m0), I_KH @ P @ I_KH.T + K @ R @ K.T


def _diagnostics(fit: _Fit, gain: np.ndarray, answers: Answers) -> dict[str, float]:
    """What one frame scatters by, what a turned guess leaves behind, and how many answers counted for nothing."""
    turned = np.diag(gain)[:3]
    return {
        "frame_scatter_deg": float(np.degrees(np.linalg.norm(fit.scatter[:3]))),
        "frame_scatter_m": float(np.linalg.norm(fit.scatter[3:])),
        "repeated_rotation": float(np.abs(turned).max()),
        "repeated_translation": float(np.abs(np.diag(gain)[3:]).max()),
        "answers": float(len(answers.answer)),
        "answers_outlying": float(np.sum(fit.weight.max(axis=1) <= 0)),
    }

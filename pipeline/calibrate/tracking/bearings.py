"""Robust rotation between two sensors from bearings of objects that both track, and a test whether it has changed.

The reference sensor measures the position of an object, the other one its direction. Translations stay at the
prior, because bearings of distant objects hardly depend on them. Geman-McClure weights with a decreasing
width reject wrong pairs of tracks.

Source: Persic et al. 2021 (graph-based rotation calibration, decalibration detection; their translations are
known); Yang et al. 2020, "Graduated non-convexity for robust spatial perception"; Hotelling 1931 (the test).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.stats import f as f_distribution

from pipeline.calibrate.numerics.covariance import bootstrap_covariance
from pipeline.rig.se3 import exp_so3, from_rotation_translation, hat, log_so3
from pipeline.rig.spherical import spherical_jacobian, to_spherical, wrap_angle

__all__ = ["AlignedBearings", "Bearings", "align_bearings", "consistency"]

_INTRACLASS = 0.5  # correlation of sightings of one track
_LEAST_SCALE = 0.2  # of the sightings' spread, in their stated sigmas
_OUTLIER_WEIGHT = 0.25
_CONFIDENCE = 0.999
# Graduated non-convexity: Geman-McClure scale in sigmas, narrowed at each step, then kept for the last steps, in the
# first of which the sightings' spread is estimated anew.
_WIDEST, _NARROWEST, _NARROWING = 12.0, 2.0, 0.7
_LAST_STEPS, _SPREAD_STEPS = 12, 6


@dataclass(frozen=True, eq=False)
class Bearings:
    """Sightings of objects by both sensors.

    `inverted` False: T takes reference points to the other sensor (q = R p + t); True: T takes the other
    sensor's points to the reference (q = R^T (p - t)). `level` rotates the other sensor's axes to level ones
    (x forward, y left, z up).
    """

    point_m: Float[np.ndarray, "N 3"]  # reference axes
    bearing_rad: Float[np.ndarray, "N A"]  # azimuth and, where measured, elevation; other sensor, level axes
    sigma_rad: Float[np.ndarray, " N"]
    track: Int64[np.ndarray, " N"]
    level: np.ndarray
    inverted: bool

    @property
    def tracks(self) -> int:
        """Number of tracks."""
        return int(self.track.max(initial=-1)) + 1

    def residuals(self, T: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray]:
        """Expected minus measured bearings [rad] (N A), and derivatives (N A 6).

        Derivatives are by a left perturbation of T's rotation and a shift of its origin.
        """
        R, t = T[:3, :3], T[:3, 3]
        if self.inverted:
            L = self.level @ R.T
            arm = self.point_m - t
            q = arm @ L.T
            turn, shift = L @ hat(arm), -np.broadcast_to(L, (len(q), 3, 3))
        else:
            arm = self.point_m @ R.T
            q = (arm + t) @ self.level.T
            turn, shift = -self.level @ hat(arm), np.broadcast_to(self.level, (len(q), 3, 3))
        axes = self.bearing_rad.shape[1]
        angles = spherical_jacobian(q)[:, :axes]
        J = np.concatenate([angles @ turn, angles @ shift], axis=2)
        return wrap_angle(to_spherical(q)[:, :axes] - self.bearing_rad), J


@dataclass(frozen=True, eq=False)
class AlignedBearings:
    """The rotation, and the sightings used."""

    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]  # without a bias floor; translation is the prior's
    spread: Float[np.ndarray, "3 3"]  # part of the rotation's covariance that comes from resampling tracks
    kept: Bool[np.ndarray, " K"]  # tracks that agree
    residual_rad: Float[np.ndarray, " A"]  # robust standard deviation of the kept sightings


def align_bearings(
    bearings: Bearings,
    T_prior: Float[np.ndarray, "4 4"],
    prior_covariance: Float[np.ndarray, "6 6"],
    rng: np.random.Generator,
) -> AlignedBearings:
    """Rotate T_prior until the bearings agree; its translation is kept."""
    T, prior_information = T_prior, np.linalg.inv(prior_covariance[:3, :3])
    count = np.bincount(bearings.track, minlength=bearings.tracks)[bearings.track]
    share = 1 / (1 + _INTRACLASS * (count - 1))  # sightings of one track err together
    scale = np.ones(bearings.bearing_rad.shape[1])
    c, rounds = _WIDEST, 0
    while True:
        z, J = _whitened(bearings, T, scale)
        weight = _geman_mcclure(z, c)
        H = np.einsum("n,nai,naj->ij", share * weight, J[..., :3], J[..., :3]) + prior_information
        turned = log_so3(T[:3, :3] @ T_prior[:3, :3].T)
        g = np.einsum("n,nai,na->i", share * weight, J[..., :3], z) + prior_information @ turned
        step = -np.linalg.solve(H, g)
        T = from_rotation_translation(exp_so3(step) @ T[:3, :3], T[:3, 3])
        if c <= _NARROWEST:
            rounds += 1
            if rounds == _LAST_STEPS:
                break
            z, _ = _whitened(bearings, T, np.ones_like(scale))
            scale = np.maximum(_spread(z), _LEAST_SCALE) if rounds < _SPREAD_STEPS else scale
        c = max(c * _NARROWING, _NARROWEST)
    z, J = _whitened(bearings, T, scale)
    weight = _geman_mcclure(z, c)
    per_track = np.bincount(bearings.track, weight, minlength=bearings.tracks)
    kept = per_track > _OUTLIER_WEIGHT * np.bincount(bearings.track, minlength=bearings.tracks)
    covariance, resampled = _covariance(bearings, z, J, share * weight, prior_covariance, rng)
    inliers = weight > _OUTLIER_WEIGHT
    spread = _spread(bearings.residuals(T)[0][inliers]) if inliers.any() else np.full(len(scale), np.nan)
    return AlignedBearings(T, covariance, resampled, kept, spread)


def consistency(
    aligned: AlignedBearings, T_prior: Float[np.ndarray, "4 4"], bias_floor_rad: Float[np.ndarray, " 3"]
) -> tuple[float, float]:
    """Squared distance in sigmas of the rotation found from the prior's, and its 99.9 % quantile.

    The threshold is Hotelling's instead of chi^2, because the spread of few tracks is itself uncertain.
    Effective degrees of freedom after Welch and Satterthwaite account for the part of the sigma that is
    spread and the part that is bias.

    Args:
        bias_floor_rad: sigma per axis of the error common to all tracks.
    """
    turned = log_so3(aligned.T[:3, :3] @ T_prior[:3, :3].T)
    covariance = aligned.covariance[:3, :3] + np.diag(bias_floor_rad**2)
    n, p = int(aligned.kept.sum()), 3
    if n < 2:
        return 0.0, float("inf")
    # Along the axis that contributes most to the turn: share of the variance that is estimated from n tracks' spread.
    u = np.linalg.solve(covariance, turned)
    share = float(u @ aligned.spread @ u) / max(float(u @ covariance @ u), 1e-300)
    dof = (n - 1) / max(share, 1e-3) ** 2
    if dof <= p:
        return 0.0, float("inf")
    threshold = p * dof / (dof - p + 1) * f_distribution.ppf(_CONFIDENCE, p, dof - p + 1)
    return float(turned @ u), float(threshold)


def _whitened(bearings: Bearings, T: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    residual, J = bearings.residuals(T)
    sigma = bearings.sigma_rad[:, None] * scale
    return residual / sigma, J / sigma[..., None]


def _geman_mcclure(z: np.ndarray, c: float) -> np.ndarray:
    return (c * c / (c * c + np.sum(z**2, axis=1))) ** 2


def _spread(z: np.ndarray) -> np.ndarray:
    """Robust standard deviation per column, about zero."""
    return 1.4826 * np.median(np.abs(z), axis=0) if len(z) else np.ones(z.shape[1])


def _covariance(
    bearings: Bearings,
    z: np.ndarray,
    J: np.ndarray,
    weight: np.ndarray,
    prior_covariance: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Bootstrap covariance of the rotation over tracks, with and without the sigma of the fixed translation."""
    K = bearings.tracks
    H6, g6 = np.zeros((K, 6, 6)), np.zeros((K, 6))
    np.add.at(H6, bearings.track, np.einsum("n,nai,naj->nij", weight, J, J))
    np.add.at(g6, bearings.track, np.einsum("n,nai,na->ni", weight, J, z))
    prior_information = np.linalg.inv(prior_covariance[:3, :3])
    rotation = bootstrap_covariance(H6[:, :3, :3], g6[:, :3], prior_information, np.arange(K), rng)
    total = H6.sum(0)
    # Turn [rad] per metre of translation error.
    slope = -np.linalg.solve(total[:3, :3] + prior_information, total[:3, 3:])
    translation = prior_covariance[3:, 3:]
    covariance = prior_covariance.copy()
    covariance[:3, :3] = rotation + slope @ translation @ slope.T
    covariance[:3, 3:] = slope @ translation
    covariance[3:, :3] = covariance[:3, 3:].T
    return covariance, rotation

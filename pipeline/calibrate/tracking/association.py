"""Tracks of two sensors paired mainly by their motion and last by their position, and the turn by which they agree.

Range and range rate over ground do not depend on a sensor's rotation. Neither does the bearing as a function of time,
up to a constant. The constant, the mean difference of the bearings, may be as large as the uncertainty of the prior.
All are compared over the frames that both tracks share. A sighting belongs to one pair only. If a track of one sensor
is interrupted, one track of the other sensor may have several successive partners.

The reference sensor measures the position of an object, the other one its direction. Translations stay at the prior,
because bearings of distant objects hardly depend on them. Geman-McClure weights with a decreasing width reject wrong
pairs of tracks.

Source: Persic et al. 2021 ("calibration-agnostic track to track association": the measure is our reading of it;
graph-based rotation calibration, decalibration detection; their translations are known); Yang et al. 2020, "Graduated
non-convexity for robust spatial perception"; Hotelling 1931 (the test).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.special import fdtri

from pipeline.calibrate.numerics.covariance import bootstrap_covariance
from pipeline.calibrate.tracking.object_tracks import Track
from pipeline.core.rows import join_rows, take_rows
from pipeline.rig.se3 import (
    exp_so3,
    from_rotation_translation,
    hat,
    inverse,
    log_so3,
    spherical_jacobian,
    to_spherical,
    transform_points,
    wrap_angle,
)

__all__ = [
    "AlignedBearings", "Association", "Bearings", "Shared", "align_bearings", "associate", "bearing_sigma_rad",
    "consistency", "shared_sightings",
]  # fmt: skip

_LEAST_SHARED = 2
_MOST_COUNTED = 8  # sightings of one track err together: a longer one is not ever more certain
_LIKENESS = 6.0  # mean squared deviation in sigmas over up to four quantities
_MOST_SQUARE = 9.0  # of one quantity in one sighting: first velocities and half-hidden boxes may be far off
_CONSTANT_SIGMAS = 3.0
_CENTRE_SIGMA_M, _ANGLE_SIGMA_RAD = 0.5, np.radians(0.5)  # the sensors mean different points of one object
_RANGE_OFFSET_SIGMA_M = 1.0  # near side against centre


@dataclass(frozen=True, eq=False)
class Association:
    """Pairs of tracks (rows of the reference's and of the other sensor's), and their shared sightings."""

    reference: Int64[np.ndarray, " K"]
    other: Int64[np.ndarray, " K"]
    sightings: Int64[np.ndarray, " S"]  # rows of `Shared.of_reference`, pair by pair
    pair: Int64[np.ndarray, " S"]  # 0..K-1


@dataclass(frozen=True, eq=False)
class Shared:
    """Sightings in common frames of all pairs of tracks with at least two such frames, one pair after the other."""

    reference: Int64[np.ndarray, " P"]
    other: Int64[np.ndarray, " P"]
    first: Int64[np.ndarray, " P"]  # of each pair's sightings
    count: Int64[np.ndarray, " P"]
    of_reference: Track  # S sightings each, row by row of the same frame
    of_other: Track


def associate(
    shared: Shared,
    T_other_reference: Float[np.ndarray, "4 4"],
    rotation_sigma_rad: float,
    *,
    elevation: bool = True,
) -> Association:
    """Pair tracks inside the gates, best scores first; a pair must not use a sighting of a better pair.

    Args:
        shared: sightings by the reference and the other sensor in common frames, in levelled axes.
        elevation: False if one of the two does not measure elevation.
    """
    kept = np.zeros(0, np.int64)
    if len(shared.first):
        score = _scores(shared, T_other_reference, rotation_sigma_rad, elevation=elevation)
        kept = _without_conflict(shared, score)
    pair = np.repeat(np.arange(len(shared.first)), shared.count)
    sightings = np.flatnonzero(np.isin(pair, kept))
    return Association(
        shared.reference[kept], shared.other[kept], sightings, np.searchsorted(kept, pair[sightings])
    )


def shared_sightings(reference: Sequence[Track], other: Sequence[Track]) -> Shared:
    """All pairs of tracks of one drive with at least two common frames."""
    rows = [(i, k, t.drive, int(f)) for i, t in enumerate(reference) for k, f in enumerate(t.frame)]
    at: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for j, t in enumerate(other):
        for k, f in enumerate(t.frame):
            at.setdefault((t.drive, int(f)), []).append((j, k))
    joined = np.array(
        sorted((i, j, k, m) for i, k, drive, f in rows for j, m in at.get((drive, f), ())), np.int64
    ).reshape(-1, 4)
    _, first, count = np.unique(joined[:, :2], axis=0, return_index=True, return_counts=True)
    often = count >= _LEAST_SHARED
    joined = joined[np.repeat(often, count)]
    count = count[often].astype(np.int64)
    first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64) if len(count) else count
    return Shared(
        joined[first, 0], joined[first, 1], first, count, _gathered(reference, joined[:, 0], joined[:, 2]),
        _gathered(other, joined[:, 1], joined[:, 3]),
    )  # fmt: skip


def bearing_sigma_rad(range_m: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Sigma of the difference of two sensors' bearings to one object: half a metre and half a degree."""
    return np.hypot(_ANGLE_SIGMA_RAD, _CENTRE_SIGMA_M / np.maximum(range_m, 1.0))


def _without_conflict(shared: Shared, score: Float[np.ndarray, " P"]) -> Int64[np.ndarray, " K"]:
    """The best pairs first; further pairs of a track must not share its sightings."""
    taken: set[tuple[int, int, int]] = set()
    kept = []
    for k in np.argsort(-score, kind="stable"):
        if score[k] <= 0:
            break
        rows = slice(shared.first[k], shared.first[k] + shared.count[k])
        claims = {
            (side, int(track), int(f))
            for side, track in enumerate((shared.reference[k], shared.other[k]))
            for f in shared.of_reference.frame[rows]
        }
        if taken.isdisjoint(claims):
            taken |= claims
            kept.append(int(k))
    return np.array(sorted(kept), np.int64)


def _scores(
    shared: Shared, T_b_a: np.ndarray, rotation_sigma_rad: float, *, elevation: bool
) -> Float[np.ndarray, " P"]:
    """Evidence that each pair of tracks is one object; 0 outside the gates.

    It is the margin between the gate and the mean squared deviation, times the sightings, minus the square of
    the constant.
    """
    a, b, first, count = shared.of_reference, shared.of_other, shared.first, shared.count
    expected = to_spherical(transform_points(T_b_a, a.position_m))
    seen = to_spherical(b.position_m)
    sigma = bearing_sigma_rad(seen[:, 2])
    axes = 2 if elevation else 1
    gap = wrap_angle(seen[:, :axes] - expected[:, :axes])
    constant = np.stack([_medians(gap[:, k], first, count) for k in range(axes)], axis=1)
    # Ranges about the other sensor's origin and range rates along its line of sight: no rotation enters.
    rate_a = _along(a.velocity_mps, a.position_m - inverse(T_b_a)[:3, 3])
    rate_b = _along(b.velocity_mps, b.position_m)
    range_var = a.range_sigma_m**2 + b.range_sigma_m**2 + _RANGE_OFFSET_SIGMA_M**2
    rate_var = a.rate_sigma_mps**2 + b.rate_sigma_mps**2
    squares = np.column_stack(
        [
            (seen[:, 2] - expected[:, 2]) ** 2 / range_var,
            (rate_b - rate_a) ** 2 / rate_var,
            ((gap - np.repeat(constant, count, axis=0)) / sigma[:, None]) ** 2,
        ]
    )
    deviation = np.minimum(squares, _MOST_SQUARE).sum(axis=1)
    left = _LIKENESS - np.add.reduceat(deviation, first) / count
    typical = _medians(sigma, first, count)
    constant_square = np.sum(constant**2, axis=1) / (rotation_sigma_rad**2 + typical**2)
    inside = (left > 0) & (constant_square < _CONSTANT_SIGMAS**2 * axes)
    return np.where(inside, np.maximum(np.minimum(count, _MOST_COUNTED) * left - constant_square, 0.0), 0.0)


def _medians(value: np.ndarray, first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Median of each segment of values."""
    ordered = value[np.lexsort((value, np.repeat(np.arange(len(first)), count)))]
    return 0.5 * (ordered[first + (count - 1) // 2] + ordered[first + count // 2])


def _along(velocity: np.ndarray, direction: np.ndarray) -> np.ndarray:
    return np.sum(velocity * direction, axis=1) / np.maximum(np.linalg.norm(direction, axis=1), 1e-6)


def _gathered(tracks: Sequence[Track], track: np.ndarray, row: np.ndarray) -> Track:
    """The named sightings of many tracks in one, in the order named."""
    if not tracks:
        none, nothing = np.zeros(0, np.int64), np.zeros(0)
        return Track(-1, none, none, np.zeros((0, 3)), np.zeros((0, 3)), nothing, nothing, np.zeros((0, 3)))
    start = np.concatenate([[0], np.cumsum([t.sightings for t in tracks])[:-1]]).astype(np.int64)
    return take_rows(join_rows(tracks), start[track] + row)


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
    threshold = p * dof / (dof - p + 1) * fdtri(p, dof - p + 1, _CONFIDENCE)
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
    bearings: Bearings, z: np.ndarray, J: np.ndarray, weight: np.ndarray, prior_covariance: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
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

"""The radar's own velocity from the Doppler of the static world, and what moves in it.

Range rate of a static point in direction u seen from a radar with velocity v: `-u . v`, known only modulo
the Doppler period where the radar is ambiguous. Wide fields of view lift that: points at 30 deg to the side
see 13 % less than points ahead, so a wrong multiple of the period does not fit.

Source: Kellner et al. 2013, "Instantaneous ego-motion estimation using Doppler radar" (their sine fit, here
with wrapped residuals and a grid of hypotheses instead of RANSAC, which makes it deterministic).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8
from numba import njit

from pipeline.config import PerceiveConfig

__all__ = ["MOVING", "STATIC", "UNDECIDED", "RadarMotion", "cluster_moving", "radar_motion"]

STATIC, MOVING, UNDECIDED = 0, 1, 2

_SPEED_MPS = (-8.0, 60.0)  # reversing to motorway
_LATERAL_MPS = 3.0  # yaw rate times lever arm, and a radar mounted askew
_VERTICAL_SLOPE = 0.1  # sigma of vertical over forward velocity: mounting pitch and road slope, 6 deg
_GRID_STEP_MPS = 0.2
_GRID_SIGMA_MPS = 0.3  # covers the grid's own error
_GRID_POINTS = 200
_MIN_POINTS = 12  # fewer say nothing about which of them stand still
_MIN_STATIC_FRACTION = 0.35
_MIN_STATIC_FRACTION_WITH_HINT = 0.1
_NOISE_FLOOR_MPS = 0.03


@dataclass(frozen=True, eq=False)
class RadarMotion:
    """Outcome for one scan; velocity is None, and all undecided, where no static world was found."""

    velocity_mps: Float[np.ndarray, " 3"] | None
    velocity_cov: Float[np.ndarray, "3 3"] | None
    residual_mps: Float32[np.ndarray, " M"]
    motion: UInt8[np.ndarray, " M"]
    cluster: Int32[np.ndarray, " M"]


def radar_motion(
    xyz_m: Float32[np.ndarray, "M 3"],
    range_rate_mps: Float32[np.ndarray, " M"],
    power_db: Float32[np.ndarray, " M"] | None,
    period_mps: float | None,
    speed_hint_mps: float | None,
    has_elevation: bool,
    config: PerceiveConfig,
    rng: np.random.Generator,
) -> RadarMotion:
    """Fit the radar's own velocity, tell static from moving detections and cluster the moving ones.

    Args:
        xyz_m: detections, radar frame (x forward, y left, z up).
        range_rate_mps: positive = receding, not ego-compensated.
        power_db: strong detections are preferred in the search for the velocity; None = all alike.
        period_mps: range rates are known modulo this; None = unambiguous.
        speed_hint_mps: forward speed from odometry, good to 1.5 m/s + 5 %; None = search all speeds.
        has_elevation: False leaves elevations out (vertical velocity is then 0, with its prior variance).
        config: gates and cluster size.
        rng: picks the detections that the search looks at.

    Returns:
        Velocity with covariance in radar axes, residuals (measured minus static, wrapped), motion, clusters.
    """
    M = len(xyz_m)
    undecided = RadarMotion(
        None, None, np.zeros(M, np.float32), np.full(M, UNDECIDED, np.uint8), np.full(M, -1, np.int32)
    )
    usable = (
        np.isfinite(xyz_m).all(1) & np.isfinite(range_rate_mps) & (np.hypot(xyz_m[:, 0], xyz_m[:, 1]) > 1.0)
    )
    if usable.sum() < _MIN_POINTS:
        return undecided
    u = _directions(xyz_m[usable].astype(np.float64), has_elevation)
    rate = range_rate_mps[usable].astype(np.float64)
    power = None if power_db is None else power_db[usable].astype(np.float64)
    fit = _fit_static_world(u, rate, power, period_mps or 0.0, speed_hint_mps, config.static_gate_mps, rng)
    if fit is None:
        return undecided
    velocity, covariance, noise = fit
    residual = np.zeros(M)
    residual[usable] = _wrapped(rate + u @ velocity, period_mps or 0.0)
    motion = np.full(M, UNDECIDED, np.uint8)
    # Between three sigmas of the static world and the gate, slow walkers and noise look alike: undecided.
    motion[usable & (np.abs(residual) < min(max(3 * noise, 0.12), config.static_gate_mps))] = STATIC
    motion[usable & (np.abs(residual) > config.static_gate_mps)] = MOVING
    cluster = cluster_moving(xyz_m, residual, motion == MOVING, period_mps or 0.0, config.radar_cluster_eps_m)
    return RadarMotion(velocity, covariance, residual.astype(np.float32), motion, cluster)


def cluster_moving(
    xyz_m: Float32[np.ndarray, "M 3"],
    residual_mps: Float[np.ndarray, " M"],
    is_moving: np.ndarray,
    period_mps: float,
    eps_m: float,
    min_points: int = 2,
) -> Int32[np.ndarray, " M"]:
    """Density clusters (DBSCAN) of moving detections in x, y and Doppler; -1 = none.

    `eps_m` metres count as 1 m/s; lengths shrink with range, as azimuth noise spreads far objects sideways.

    Args:
        xyz_m: detections [m].
        residual_mps: range rate over ground; compared modulo `period_mps` where that is positive.
        is_moving: which detections take part.
        period_mps: 0 = unambiguous.
        eps_m: neighbourhood near the car.
        min_points: detections (with itself) that make a core; far cars give a scanning radar two.

    Source: Ester et al. 1996.
    """
    label = np.full(len(xyz_m), -1, np.int32)
    index = np.flatnonzero(is_moving)
    if not len(index):
        return label
    xy = xyz_m[index, :2].astype(np.float64)
    scale = eps_m * (1 + np.hypot(*xy.T) / 60.0)
    distance = np.linalg.norm(xy[:, None] - xy[None], axis=-1) / np.minimum(scale[:, None], scale[None])
    doppler = np.abs(_wrapped(residual_mps[index][:, None] - residual_mps[index][None], period_mps))
    near = np.hypot(distance, doppler) <= 1.0
    core = near.sum(1) >= min_points
    label[index] = _connect(near, core)
    return label


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _connect(near: np.ndarray, core: np.ndarray) -> np.ndarray:
    """Labels of the connected cores and the points that they reach."""
    n = len(core)
    label = np.full(n, -1, np.int32)
    stack = np.empty(n, np.int64)
    count = 0
    for seed in range(n):
        if not core[seed] or label[seed] >= 0:
            continue
        label[seed] = count
        stack[0] = seed
        top = 1
        while top:
            top -= 1
            i = stack[top]
            for j in range(n):
                if near[i, j] and label[j] < 0:
                    label[j] = count
                    if core[j]:
                        stack[top] = j
                        top += 1
        count += 1
    return label


def _directions(xyz: np.ndarray, has_elevation: bool) -> np.ndarray:
    """Unit vectors; flat ones where elevations mean nothing."""
    xyz = xyz if has_elevation else xyz * [1.0, 1.0, 0.0]
    return xyz / np.linalg.norm(xyz, axis=1, keepdims=True)


def _wrapped(value: np.ndarray, period: float) -> np.ndarray:
    return value - period * np.round(value / period) if period > 0 else value


def _fit_static_world(
    u: np.ndarray,
    rate: np.ndarray,
    power: np.ndarray | None,
    period: float,
    hint: float | None,
    gate: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Velocity, covariance and noise of the hypothesis that explains most; None where too little."""
    chosen = _search_points(u, power, rng)
    vx = np.arange(*_SPEED_MPS, _GRID_STEP_MPS)
    if hint is not None:
        vx = vx[np.abs(vx - hint) <= 1.5 + 0.05 * abs(hint)]
    vy = np.arange(-_LATERAL_MPS, _LATERAL_MPS + 0.01, _GRID_STEP_MPS)
    if not len(vx):
        return None
    score = _grid_score(u[chosen], rate[chosen], vx, vy, period, _GRID_SIGMA_MPS)
    best: tuple[float, tuple[np.ndarray, np.ndarray, float]] | None = None
    for i, j in _separate_peaks(score, 4):
        fit = _refine(u, rate, np.array([vx[i], vy[j], 0.0]), period, gate)
        # Share of detections within the gate, and how many of them agree finely.
        r = _wrapped(rate + u @ fit[0], period)
        value = float(np.mean(np.exp(-0.5 * (r / 0.15) ** 2)) + np.mean(np.abs(r) < gate))
        if best is None or value > best[0]:
            best = value, fit
    assert best is not None
    r = _wrapped(rate + u @ best[1][0], period)
    static = np.abs(r) < gate
    # A bus alongside may answer with most detections of a scan; odometry tells which of the others stand still.
    least = _MIN_STATIC_FRACTION if hint is None else _MIN_STATIC_FRACTION_WITH_HINT
    return best[1] if static.sum() >= _MIN_POINTS and np.mean(static) >= least else None


def _search_points(u: np.ndarray, power: np.ndarray | None, rng: np.random.Generator) -> np.ndarray:
    """A few detections, spread in azimuth (the sides lift the ambiguity), the stronger half where known."""
    n = len(u)
    if n <= _GRID_POINTS:
        return np.arange(n)
    pool = np.arange(n)
    if power is not None:
        known = power[np.isfinite(power)]
        strong = np.flatnonzero(power >= np.median(known)) if len(known) else pool
        pool = strong if len(strong) >= _GRID_POINTS else pool
    azimuth = np.arctan2(u[pool, 1], u[pool, 0])
    bins = np.digitize(azimuth, np.quantile(azimuth, np.linspace(0, 1, 21)[1:-1]))
    bins_wide = np.digitize(azimuth, np.linspace(azimuth.min(), azimuth.max(), 21)[1:-1])
    weight = 1 / np.bincount(bins, minlength=20)[bins] + 1 / np.bincount(bins_wide, minlength=20)[bins_wide]
    return rng.choice(pool, _GRID_POINTS, replace=False, p=weight / weight.sum())


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True, fastmath=True)
def _grid_score(
    u: np.ndarray, rate: np.ndarray, vx: np.ndarray, vy: np.ndarray, period: float, sigma: float
) -> np.ndarray:
    """Sum of (1 + (r / sigma)^2)^-2 over detections for each (vx, vy)."""
    out = np.zeros((len(vx), len(vy)))
    inverse_period = 1 / period if period > 0 else 0.0
    for i in range(len(vx)):
        for j in range(len(vy)):
            total = 0.0
            for k in range(len(u)):
                r = rate[k] + u[k, 0] * vx[i] + u[k, 1] * vy[j]
                r -= period * np.floor(r * inverse_period + 0.5)
                t = 1 / (1 + (r / sigma) ** 2)
                total += t * t
            out[i, j] = total
    return out


def _separate_peaks(score: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Indices of the highest scores that lie at least 1 m/s apart."""
    score = score.copy()
    reach = round(1.0 / _GRID_STEP_MPS)
    peaks = []
    for _ in range(count):
        i, j = np.unravel_index(int(np.argmax(score)), score.shape)
        if score[i, j] <= 0:
            break
        peaks.append((int(i), int(j)))
        score[max(0, i - reach) : i + reach + 1, max(0, j - reach) : j + reach + 1] = 0
    return peaks


def _refine(
    u: np.ndarray, rate: np.ndarray, velocity: np.ndarray, period: float, gate: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Reweighted least squares (Geman-McClure, from the gate to the noise), weak prior on the vertical."""
    scale = max(gate, _GRID_SIGMA_MPS)
    noise, information = scale, np.eye(3)
    for _ in range(12):
        r = _wrapped(rate + u @ velocity, period)
        near = np.abs(r[np.abs(r) < gate])
        noise = float(np.clip(1.4826 * np.median(near), _NOISE_FLOOR_MPS, gate)) if len(near) else gate
        scale = max(0.6 * scale, 2.5 * noise)
        w = (1 + (r / scale) ** 2) ** -2
        # Poor elevations say nothing about the vertical: the prior keeps it from running away.
        vertical = 1 / (0.05 + _VERTICAL_SLOPE * abs(velocity[0])) ** 2
        information = (u.T * w) @ u / noise**2 + np.diag([1e-6, 1e-6, vertical])
        step = np.linalg.solve(information, -(u.T @ (w * r)) / noise**2 - [0, 0, vertical * velocity[2]])
        velocity = velocity + step
    return velocity, np.linalg.inv(information), noise

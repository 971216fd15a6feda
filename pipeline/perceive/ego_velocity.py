"""The radar's own velocity from the Doppler of the static world, and the moving detections.

Range rate of a static point in direction u seen from a radar with velocity v: `-u . v`, known only modulo the
Doppler period if the radar is ambiguous. Wide fields of view resolve that: points at 30 deg to the side see
13 % less than points ahead, so a wrong multiple of the period does not fit.

The search is centred on the direction of travel from the mounting prior, so corner and rear radars need no
special case. Without a prior, or without a result, it widens; at last it ignores odometry and prior, which
may be wrong.

Source: Kellner et al. 2013, "Instantaneous ego-motion estimation using Doppler radar" (their sine fit, here
with wrapped residuals and a grid of hypotheses instead of RANSAC, which makes it deterministic).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8
from numba import njit

from pipeline.core.config import PerceiveConfig
from pipeline.perceive.dbscan import cluster_moving, wrapped
from pipeline.perceive.ground import median_of

__all__ = ["MOVING", "STATIC", "UNDECIDED", "RadarMotion", "Travel", "radar_motion"]

STATIC, MOVING, UNDECIDED = 0, 1, 2

_SPEED_MPS = (-8.0, 60.0)  # reversing to motorway
_LATERAL_MPS = 3.0  # yaw rate times lever arm, and a radar mounted askew
# The wider search: coarser, for it covers 20 times the velocities; refining needs a start within about 1 m/s.
_WIDE_STEP_MPS, _WIDE_SIGMA_MPS = 0.5, 0.5
_WIDE_CONE_RAD = np.radians(30.0)  # about a known heading: more than any bracket bends
_CONVINCING = 1.0  # of 2, see `_value`: below it the wider search is tried too
_CLEARLY = 0.1  # by so much must an answer far from the heading be better
_VERTICAL_SLOPE = 0.1  # sigma of vertical over forward velocity: mounting pitch and road slope, 6 deg
_GRID_STEP_MPS = 0.2
_GRID_SIGMA_MPS = 0.3  # covers the grid's own error
_GRID_POINTS = 200
_PEAKS, _APART_MPS = 4, 1.0
_MIN_POINTS = 12  # fewer say nothing about which of them stand still
_MIN_STATIC_FRACTION = 0.35
_MIN_STATIC_FRACTION_WITH_HINT = 0.1
# What fits by chance fills the gate evenly, with a noise of .74 of it; what stands fits finely, even beside a bus that
# fills the scan. And by so much more of a scan must fit without odometry and mounting.
_COARSE, _MISLED = 0.45, 0.2
_NOISE_FLOOR_MPS = 0.03


@dataclass(frozen=True)
class Travel:
    """Prior knowledge of the radar's own velocity; None = unknown."""

    speed_mps: float | None = None  # forward, from odometry; good to 1.5 m/s + 5 %
    heading_rad: float | None = None  # azimuth in radar axes of the car's way ahead, from the mounting prior


@dataclass(frozen=True, eq=False)
class RadarMotion:
    """Result for one scan; velocity is None, and all undecided, if no static world was found."""

    velocity_mps: Float[np.ndarray, " 3"] | None
    velocity_cov: Float[np.ndarray, "3 3"] | None
    residual_mps: Float32[np.ndarray, " M"]
    motion: UInt8[np.ndarray, " M"]
    cluster: Int32[np.ndarray, " M"]


def radar_motion(
    xyz_m: Float32[np.ndarray, "M 3"], range_rate_mps: Float32[np.ndarray, " M"],
    power_db: Float32[np.ndarray, " M"] | None, period_mps: float | None, travel: Travel, has_elevation: bool,
    config: PerceiveConfig, rng: np.random.Generator,
) -> RadarMotion:  # fmt: skip
    """Fit the radar's own velocity, separate static from moving detections and cluster the moving ones.

    Args:
        range_rate_mps: positive = receding, not ego-compensated.
        power_db: power; the search for the velocity prefers strong detections; None = equal weights.
        period_mps: range rates are known modulo this; None = unambiguous.
        travel: centre of the search; a wrong heading only costs time, because the search is widened if the
            scan contradicts it.
        has_elevation: False leaves elevations out (vertical velocity is then 0, with its prior variance).

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
    power = None if power_db is None else power_db[usable].astype(np.float64)
    directions = xyz_m[usable] * np.array([1.0, 1.0, float(has_elevation)])
    scan = _Doppler(
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        range_rate_mps[usable].astype(np.float64),
        period_mps or 0.0,
        config.static_gate_mps,
    )
    fit = _fit(scan, power, travel, rng)
    if fit is None:
        return undecided
    velocity, covariance, noise = fit
    residual = np.zeros(M)
    residual[usable] = scan.residual(velocity)
    motion = np.full(M, UNDECIDED, np.uint8)
    # Between three sigmas of the static world and the gate, slow walkers and noise look alike: undecided.
    motion[usable & (np.abs(residual) < min(max(3 * noise, 0.12), config.static_gate_mps))] = STATIC
    motion[usable & (np.abs(residual) > config.static_gate_mps)] = MOVING
    cluster = cluster_moving(xyz_m, residual, motion == MOVING, period_mps or 0.0, config.radar_cluster_eps_m)
    return RadarMotion(velocity, covariance, residual.astype(np.float32), motion, cluster)


_Fit = tuple[np.ndarray, np.ndarray, float]  # velocity, covariance, noise


@dataclass(frozen=True, eq=False)
class _Doppler:
    """Directions and range rates of a scan; `gate` is the tolerance of the static world."""

    u: np.ndarray
    rate: np.ndarray
    period: float
    gate: float

    def residual(self, velocity: np.ndarray) -> np.ndarray:
        """Measured minus static range rates, wrapped."""
        return wrapped(self.rate + self.u @ velocity, self.period)

    def static_share(self, fit: _Fit) -> float:
        """Share of detections within the gate."""
        return float(np.mean(np.abs(self.residual(fit[0])) < self.gate))

    def value(self, fit: _Fit) -> float:
        """Share of detections within the gate, and how many of them agree finely: 0 to 2."""
        return float(np.mean(np.exp(-0.5 * (self.residual(fit[0]) / 0.15) ** 2))) + self.static_share(fit)

    def best_fit(self, starts: np.ndarray) -> _Fit | None:
        """The start that explains most, refined by reweighted least squares; None without starts."""
        about = self.u, self.rate, self.period, self.gate
        fits = (_reweighted(*about, np.append(start, 0.0)) for start in starts)
        return max(((v, np.linalg.inv(A), noise) for v, A, noise in fits), key=self.value, default=None)


def _fit(scan: _Doppler, power: np.ndarray | None, travel: Travel, rng: np.random.Generator) -> _Fit | None:
    """Fit of the static world near odometry and mounting, or from the scan alone if that fits much better.

    A wrong odometry, mounting or Doppler sign would otherwise select the few detections that fit it;
    `calibrate/verify/motion_sources.py` finds out which one is wrong.
    """
    fit = _fit_static_world(scan, power, travel, rng)
    share = 0.0 if fit is None else scan.static_share(fit)
    is_fine = fit is not None and fit[2] < _COARSE * scan.gate
    if travel == Travel() or share >= _MIN_STATIC_FRACTION or is_fine:
        return fit
    alone = _fit_static_world(scan, power, Travel(), rng)
    is_better = alone is not None and scan.static_share(alone) > share + _MISLED
    return alone if is_better else fit


def _fit_static_world(
    scan: _Doppler, power: np.ndarray | None, travel: Travel, rng: np.random.Generator
) -> _Fit | None:
    """Velocity, covariance and noise of the best hypothesis; None if too few detections fit."""
    chosen = _search_points(scan.u, power, rng)
    u, rate = scan.u[chosen], scan.rate[chosen]
    best = scan.best_fit(_starts(u, rate, _ahead(travel), scan.period, _GRID_SIGMA_MPS))
    if best is None or travel.heading_rad is None or scan.value(best) < _CONVINCING:
        # Every third detection: the coarse grid is large.
        wide = scan.best_fit(_starts(u[::3], rate[::3], _around(travel), scan.period, _WIDE_SIGMA_MPS))
        if wide is not None and (best is None or scan.value(wide) > scan.value(best) + _CLEARLY):
            best = wide
    if best is None:
        return None
    share = scan.static_share(best)
    # A bus alongside may have most detections of a scan; odometry identifies the static others.
    least = _MIN_STATIC_FRACTION if travel.speed_mps is None else _MIN_STATIC_FRACTION_WITH_HINT
    return best if share * len(scan.u) >= _MIN_POINTS - 0.5 and share >= least else None


def _ahead(travel: Travel) -> np.ndarray:
    """Velocities (K 2) to try: any speed near the heading (ahead if unknown)."""
    along = np.arange(*_SPEED_MPS, _GRID_STEP_MPS)
    if travel.speed_mps is not None:
        along = along[np.abs(along - travel.speed_mps) <= _speed_margin(travel.speed_mps)]
    aside = np.arange(-_LATERAL_MPS, _LATERAL_MPS + 0.01, _GRID_STEP_MPS)
    v = np.stack(np.meshgrid(along, aside, indexing="ij"), -1).reshape(-1, 2)
    c, s = np.cos(travel.heading_rad or 0.0), np.sin(travel.heading_rad or 0.0)
    return v @ np.array([[c, s], [-s, c]])


def _around(travel: Travel) -> np.ndarray:
    """Velocities (K 2) to try where those ahead explain too little: a cone about the heading, or all directions."""
    axis = np.arange(-_SPEED_MPS[1], _SPEED_MPS[1] + 0.01, _WIDE_STEP_MPS)
    v = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    speed = np.hypot(*v.T)
    keep = speed <= _SPEED_MPS[1]
    if travel.speed_mps is not None:
        keep &= np.abs(speed - abs(travel.speed_mps)) <= _speed_margin(travel.speed_mps)
    if travel.heading_rad is not None:
        off = np.abs(wrapped(np.arctan2(v[:, 1], v[:, 0]) - travel.heading_rad, 2 * np.pi))
        keep &= off <= _WIDE_CONE_RAD
    return v[keep]


def _speed_margin(speed_mps: float) -> float:
    return 1.5 + 0.05 * abs(speed_mps)


def _starts(
    u: np.ndarray, rate: np.ndarray, velocities: np.ndarray, period: float, sigma: float
) -> np.ndarray:
    """The few velocities (K 2) with most support, at least 1 m/s apart."""
    score = _scores(
        *np.ascontiguousarray(u[:, :2].T), rate, *np.ascontiguousarray(velocities.T), period, sigma
    )
    peaks = []
    for _ in range(_PEAKS):
        if not len(score) or score.max() <= 0:
            break
        peaks.append(velocities[int(np.argmax(score))])
        off = np.abs(velocities - peaks[-1]) <= _APART_MPS + 1e-9
        score[off[:, 0] & off[:, 1]] = 0
    return np.array(peaks).reshape(-1, 2)


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
def _scores(
    ux: np.ndarray, uy: np.ndarray, rate: np.ndarray, vx: np.ndarray, vy: np.ndarray, period: float,
    sigma: float,
) -> np.ndarray:  # fmt: skip
    """Sum of (1 + (r / sigma)^2)^-2 over detections for each velocity."""
    out = np.zeros(len(vx))
    inverse_period = 1 / period if period > 0 else 0.0
    for i in range(len(vx)):
        total = 0.0
        for k in range(len(ux)):
            r = rate[k] + ux[k] * vx[i] + uy[k] * vy[i]
            r -= period * np.floor(r * inverse_period + 0.5)
            t = 1 / (1 + (r / sigma) ** 2)
            total += t * t
        out[i] = total
    return out


@no_type_check
@njit(cache=True)
def _reweighted(
    u: np.ndarray, rate: np.ndarray, period: float, gate: float, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Velocity after twelve steps; information matrix and noise of the last one.

    Weights are Geman-McClure's, from the gate to the noise; the vertical has a weak prior.
    """
    v, A, g = velocity.copy(), np.zeros((3, 3)), np.zeros(3)
    residual, near = np.empty(len(rate)), np.empty(len(rate))
    scale = noise = max(gate, _GRID_SIGMA_MPS)
    for _ in range(12):
        count = 0
        for k in range(len(rate)):
            r = rate[k] + (u[k, 0] * v[0] + u[k, 1] * v[1] + u[k, 2] * v[2])
            if period > 0:
                r -= period * np.rint(r / period)
            residual[k] = r
            if abs(r) < gate:
                near[count] = abs(r)
                count += 1
        noise = min(max(1.4826 * median_of(near, count), _NOISE_FLOOR_MPS), gate) if count else gate
        scale = max(0.6 * scale, 2.5 * noise)
        A[:], g[:] = 0.0, 0.0
        for k in range(len(rate)):
            r = residual[k]
            t = 1 / (1 + (r / scale) ** 2)
            x, y, z, w = u[k, 0], u[k, 1], u[k, 2], t * t
            A[0, 0] += w * x * x
            A[0, 1] += w * x * y
            A[0, 2] += w * x * z
            A[1, 1] += w * y * y
            A[1, 2] += w * y * z
            A[2, 2] += w * z * z
            g[0] -= w * x * r
            g[1] -= w * y * r
            g[2] -= w * z * r
        # Poor elevations leave the vertical component free: the prior bounds it.
        vertical = 1 / (0.05 + _VERTICAL_SLOPE * np.hypot(v[0], v[1])) ** 2
        A[1, 0], A[2, 0], A[2, 1] = A[0, 1], A[0, 2], A[1, 2]
        A /= noise**2
        g /= noise**2
        A[0, 0] += 1e-6
        A[1, 1] += 1e-6
        A[2, 2] += vertical
        g[2] -= vertical * v[2]
        v += _solved(A, g)
    return v, A, noise


@no_type_check
@njit(cache=True)
def _solved(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solution of A x = b with A symmetric and positive definite, 3 by 3, by its Cholesky factor."""
    L, x = np.zeros((3, 3)), b.copy()
    for i in range(3):
        for j in range(i + 1):
            rest = A[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(rest) if i == j else rest / L[j, j]
    for i in range(3):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(2, -1, -1):
        for k in range(i + 1, 3):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return x

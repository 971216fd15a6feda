"""Motion of the vehicle frame per moment, from all radars' Doppler and from odometry: one value for all edges.

A radar measures its own velocity: the base's, plus the yaw rate times its lever arm. A constraint of the car
completes the sources: its rear axle does not slip, so one radar ahead of it determines the yaw rate.

Radars have rotation errors in their brackets. Each is corrected by the difference of its own direction of
travel from that of all radars. This is a constant of the day that averaging over moments does not reduce. A
source whose speed differs from that of the others in most moments is left out and reported. If there are
only two, it is unknown which one is wrong, and `calibrate/verify/motion_sources` compares both with the
lidar's sweeps.

Source: Kellner et al. 2014, "Instantaneous ego-motion estimation using multiple Doppler radars".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from schemas.observations import Observation

__all__ = [
    "DopplerMotion", "EgoMotion", "Odometry", "agreed_share", "backwards", "contradicting", "ego_motion",
    "is_same", "mean_heading", "motion_of", "shown_heading",
]  # fmt: skip

# Speeds are the same within these. On 10 good days of seven rigs, the real car's too, odometry and lidar agreed in 89 %
# of what moves and more, Doppler and lidar in 88 % (without odometry 69, and 48 for a 16-row rig whose Doppler is
# ambiguous), odometry and Doppler in 97 %; where one was wrong, in 17, 17 and 40 % at most.
_SAME_MPS, _SAME_SHARE = 0.5, 0.2
_MET, _AGREED = 0.4, 0.5
_MOSTLY = 2 / 3  # of the moments with motion: no car drives backwards for so much of a day
_MOVING_MPS, _FEWEST, _FEWEST_FRAMES = 3.0, 6, 5
_LEAST_SIGMA_MPS = 0.03  # Doppler's steps, a wheel's ticks
_ODOMETRY_SIGMAS = (0.1, 0.003)  # of speed [m/s] and yaw rate [rad/s] where nothing else shows their scatter
_ASIDE_SIGMA_MPS = 0.05  # slip of the rear axle, and a base that sways: .015 on 8 simulated days
_HARDLY = np.array([60.0, 60.0, 0.5]) ** -2.0  # what any car does [m/s, rad/s]
_CAUCHY, _PASSES, _ROUNDS = 2.5, 5, 3


@dataclass(frozen=True, eq=False)
class DopplerMotion:
    """A radar's own velocity from its Doppler, per moment, in its axes; NaN for a scan that does not determine it.

    `T_base_radar` is the known mounting, `yaw_sigma_rad` its uncertainty.
    """

    name: str
    velocity_mps: np.ndarray
    covariance: np.ndarray
    T_base_radar: np.ndarray
    yaw_sigma_rad: float

    def level(self) -> tuple[Float[np.ndarray, "F 2"], Float[np.ndarray, "F 2 2"]]:
        """Velocity and covariance in axes of the base."""
        R = self.T_base_radar[:2, :3]
        return self.velocity_mps @ R.T, R @ self.covariance @ R.T


@dataclass(frozen=True, eq=False)
class Odometry:
    """Forward speed and yaw rate of the base per moment; NaN where not logged."""

    speed_mps: np.ndarray
    yaw_rate_radps: np.ndarray


@dataclass(frozen=True, eq=False)
class EgoMotion:
    """Level motion of the base, per moment; NaN where no source determines it.

    Args:
        velocity_mps: F 2, velocity of the base's origin: ahead, to the left.
        yaw_rate_radps: F, positive to the left.
        covariance: F 3 3, of both; errors of different moments are independent.
        left_out: sources that contradict the others, with reasons.
    """

    velocity_mps: np.ndarray
    yaw_rate_radps: np.ndarray
    covariance: np.ndarray
    left_out: Mapping[str, str] = field(default_factory=dict)

    def at_sensor(self, T_base_sensor: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "F 3"]:
        """Velocity of a sensor's origin, in its own axes [m/s]."""
        x, y = T_base_sensor[:2, 3]
        v, w = self.velocity_mps, self.yaw_rate_radps
        return np.stack([v[:, 0] - w * y, v[:, 1] + w * x, np.zeros_like(w)], -1) @ T_base_sensor[:3, :3]


def motion_of(
    observations: Sequence[Observation], T_base_radar: Float[np.ndarray, "4 4"], yaw_sigma_rad: float
) -> tuple[DopplerMotion, Odometry]:
    """The Doppler and the odometry of frames with one radar.

    A speed without a yaw rate is odometry only if the radar has no velocity; else it is Doppler's.
    """
    nothing = np.full(3, np.nan)
    velocity = [nothing if o.radar_velocity_mps is None else o.radar_velocity_mps for o in observations]
    covariance = [np.eye(3) if o.radar_velocity_cov is None else o.radar_velocity_cov for o in observations]
    odometry = [
        (np.nan, np.nan) if o.ego_yaw_rate_radps is None or o.ego_speed_mps is None
        else (o.ego_speed_mps, o.ego_yaw_rate_radps)
        for o in observations
    ]  # fmt: skip
    speed, turn = np.array(odometry, np.float64).reshape(-1, 2).T
    doppler = DopplerMotion(
        "radar", np.array(velocity, np.float64).reshape(-1, 3), np.array(covariance, np.float64).reshape(-1, 3, 3),
        T_base_radar, yaw_sigma_rad,
    )  # fmt: skip
    return doppler, Odometry(speed, turn)


def ego_motion(
    radars: Sequence[DopplerMotion], odometry: Odometry, *, heading: tuple[float, float] | None = None
) -> EgoMotion:
    """Fuse the motion by radars and odometry.

    Args:
        radars: motion by radars at the same moments; none if odometry is complete.
        odometry: motion by odometry; all NaN if none is logged.
        heading: azimuth in axes of the base in which the car drives straight on, and its sigma [rad]: (0, 0)
            for a vehicle frame; None = from the radars' mountings, for a base that is a sensor.
    """
    speeds = {r.name: r.level()[0][:, 0] for r in radars} | {"odometry": odometry.speed_mps}
    left_out = contradicting(speeds)
    if "odometry" in left_out:
        odometry = Odometry(odometry.speed_mps * np.nan, odometry.yaw_rate_radps * np.nan)
    radars = [r for r in radars if r.name not in left_out]
    turn, scatter = np.nan_to_num(odometry.yaw_rate_radps), _scatter(radars, odometry)
    for _ in range(_ROUNDS):  # how radars are mounted shows once turns are known, and the other way round
        mounted = [_direction(r, turn) for r in radars]
        way, _ = _mean(mounted, [r.yaw_sigma_rad for r in radars]) if heading is None else heading
        equations = _of_the_car(odometry, scatter, way)
        u, H = _fused(equations, [_turned(r, way - m) for r, m in zip(radars, mounted, strict=True)])
        turn = np.where(np.isfinite(odometry.yaw_rate_radps), turn, u[:, 2])
    unknown = ~np.isfinite(np.stack(list(speeds.values()))).any(0)
    u[unknown] = np.nan
    return EgoMotion(u[:, :2], u[:, 2], np.linalg.inv(H), left_out)


def _fused(
    equations: tuple[np.ndarray, np.ndarray], radars: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Motion and information of each moment."""
    H, g = equations
    u = np.linalg.solve(H, g[..., None])[..., 0]
    for _ in range(_PASSES if radars else 0):
        H, g = equations
        for J, v, C in radars:
            more = _equations(J, v, C, u)
            H, g = H + more[0], g + more[1]
        u = np.linalg.solve(H, g[..., None])[..., 0]
    return u, H


def shown_heading(
    observations: Sequence[Observation], T_base_radar: Float[np.ndarray, "4 4"]
) -> float | None:
    """Azimuth of the direction of travel in axes of the base, from a radar's Doppler; None if it does not determine it.

    One value for all frames is used, because its noise in a single frame is larger than its variation. The
    radar's vertical velocity is not used. The sign follows from the speed, because the base's x axis points
    ahead, and a Doppler's sign may be wrong.
    """
    moving = [
        o.radar_velocity_mps
        for o in observations
        if o.radar_velocity_mps is not None and (o.ego_speed_mps or 0.0) > _MOVING_MPS
    ]
    if len(moving) < _FEWEST_FRAMES or not np.isfinite(T_base_radar).all():
        return None
    v = np.stack(moving) @ T_base_radar[:3, :3].T
    ahead = np.where(v[:, 0] < 0, -1.0, 1.0)
    return float(np.median(np.arctan2(ahead * v[:, 1], ahead * v[:, 0])))


def mean_heading(headings: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """Weighted mean of azimuths with sigmas [rad]; None without azimuths."""
    if not headings:
        return None
    first = headings[0][0]
    apart, sigma = _mean([math.remainder(a - first, math.tau) for a, _ in headings], [s for _, s in headings])
    return first + apart, sigma


def contradicting(speeds_mps: Mapping[str, Float[np.ndarray, " F"]]) -> dict[str, str]:
    """Sources whose speed contradicts the others', if these agree with each other; and a sentence on each."""
    found: dict[str, str] = {}
    known = {n: v for n, v in speeds_mps.items() if np.sum(np.abs(v) > _MOVING_MPS) >= _FEWEST}
    if len(known) < 3:
        return found
    for name, speed in known.items():
        others = np.stack([v for n, v in known.items() if n != name])
        rest = np.nanmedian(others, axis=0)
        together = min(agreed_share(v, rest) for v in others)
        met = agreed_share(speed, rest)
        if met < _MET and together >= _AGREED:
            found[name] = f"{name} has the speed of the other sources in {met:.0%} of the moments"
    return found


def backwards(speeds_mps: Mapping[str, Float[np.ndarray, " F"]]) -> list[str]:
    """Sources by which the car drives backwards for most of the day, where it drives forwards by another.

    Moments may differ from source to source.
    """
    moving = {n: v[np.abs(np.nan_to_num(v)) > _MOVING_MPS] for n, v in speeds_mps.items()}
    share = {n: float(np.mean(v < 0)) for n, v in moving.items() if len(v) >= _FEWEST}
    is_driven = any(value < 1 - _MOSTLY for value in share.values())
    return [n for n, value in share.items() if value > _MOSTLY] if is_driven else []


def agreed_share(speed_mps: Float[np.ndarray, " F"], other_mps: Float[np.ndarray, " F"]) -> float:
    """Share of the moments with motion by both sources in which the speeds agree; 1 without such moments."""
    both = np.isfinite(speed_mps) & np.isfinite(other_mps)
    a, b = speed_mps[both], other_mps[both]
    moving = np.abs(b) > _MOVING_MPS
    if not moving.any():
        return 1.0
    return float(np.mean(is_same(a[moving], b[moving])))


def is_same(
    speed_mps: Float[np.ndarray, " F"], expected_mps: Float[np.ndarray, " F"]
) -> Bool[np.ndarray, " F"]:
    """True where a speed agrees with another source's."""
    return np.asarray(np.abs(speed_mps - expected_mps) < _SAME_MPS + _SAME_SHARE * np.abs(expected_mps))


def _direction(radar: DopplerMotion, turn: np.ndarray) -> float:
    """Median azimuth of the radar's direction of travel in axes of the base, without the effect of turns."""
    velocity, _ = radar.level()
    x, y = radar.T_base_radar[:2, 3]
    at_base = velocity + turn[:, None] * [y, -x]
    moving = np.hypot(*velocity.T) > _MOVING_MPS
    if moving.sum() < _FEWEST:
        return 0.0
    ahead = at_base[moving] * np.copysign(1.0, at_base[moving, :1])
    return float(np.median(np.arctan2(ahead[:, 1], ahead[:, 0])))


def _mean(angles: Sequence[float], sigmas: Sequence[float]) -> tuple[float, float]:
    """Weighted mean, and its sigma; 0 with an infinite sigma without values."""
    if not angles:
        return 0.0, float(np.pi)
    weight = np.array(sigmas) ** -2.0
    return float(weight @ np.array(angles) / weight.sum()), float(weight.sum() ** -0.5)


def _scatter(radars: Sequence[DopplerMotion], odometry: Odometry) -> float:
    """Sigma of odometry's speed [m/s], from its differences to the radars' speeds."""
    apart = [r.level()[0][:, 0] - odometry.speed_mps for r in radars]
    known = np.concatenate(apart)[np.isfinite(np.concatenate(apart))] if apart else np.zeros(0)
    if len(known) < _FEWEST:
        return _ODOMETRY_SIGMAS[0]
    return max(1.4826 * float(np.median(np.abs(known))), _LEAST_SIGMA_MPS)


def _of_the_car(odometry: Odometry, speed_sigma_mps: float, way_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Equations of each moment by odometry, and by a rear axle without side slip, at the base's origin."""
    F = len(odometry.speed_mps)
    axle = np.array([-np.tan(way_rad), 1.0, 0.0])
    H = np.tile(np.outer(axle, axle) / _ASIDE_SIGMA_MPS**2 + np.diag(_HARDLY), (F, 1, 1))
    g = np.zeros((F, 3))
    for k, values, sigma in ((0, odometry.speed_mps, speed_sigma_mps),
                             (2, odometry.yaw_rate_radps, _ODOMETRY_SIGMAS[1])):  # fmt: skip
        known = np.isfinite(values)
        H[known, k, k] += sigma**-2
        g[known, k] += values[known] / sigma**2
    return H, g


def _turned(radar: DopplerMotion, by_rad: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Jacobian of a radar's velocity by the base's motion; velocity and covariance at the common heading."""
    velocity, covariance = radar.level()
    c, s = np.cos(by_rad), np.sin(by_rad)
    R = np.array([[c, -s], [s, c]])
    x, y = radar.T_base_radar[:2, 3]
    least = _LEAST_SIGMA_MPS**2 * np.eye(2)
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x]]), velocity @ R.T, R @ covariance @ R.T + least


def _equations(J: np.ndarray, v: np.ndarray, C: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Equations of a radar; scans that contradict the motion so far (in a convoy) have less weight."""
    known = np.isfinite(v).all(1)
    information = np.linalg.inv(np.where(known[:, None, None], C, np.eye(2)))
    r = np.where(known[:, None], v - u @ J.T, 0.0)
    far = np.einsum("fi,fij,fj->f", r, information, r)
    weight = known / (1 + far / _CAUCHY**2)
    W = weight[:, None, None] * information
    return J.T @ W @ J, np.einsum("fij,fj->fi", J.T @ W, np.nan_to_num(v))

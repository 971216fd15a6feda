"""Static radar detections against the lidar map: whitened soft assignment in the radar's azimuth, elevation, range.

Each static detection is drawn from one of the lidar points near it (or their mirror images below the ground,
or nothing): weights are Gaussian in azimuth, elevation and range with the radar's own sigmas. The ground
stays in the map. A static lidar point p appears at `q = T_radar_lidar p - v tau - w x q tau` to a radar that
looks `tau` later, where `tau = stamp_radar + dt - stamp_lidar` and v is the radar's own velocity; so dt is an
unknown wherever the car moves, and so is a constant added to all ranges, which a wide field of view
distinguishes from a translation.

Normal equations are separate for (azimuth, range) and for elevation, and the caller weights the latter: on
sparse lidars elevation is uninformative although its residuals are small, because points collapse onto the
lidar's rings.

Source: Granger & Pennec 2002, "Multi-scale EM-ICP"; Louis 1982 for the information under uncertain assignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int64

from pipeline.core.rows import columns_of, take_rows
from pipeline.objective.radar.registration_loops import STATS, accumulate_frames
from pipeline.rig.se3 import inverse, transform_points
from schemas.observations import Observation

__all__ = [
    "BOUNCE_PRIOR", "RANGE_M", "SIDE_RAD", "SIGMA_START", "STRAY", "VIEW_MARGIN_RAD", "NormalEquations",
    "RegistrationFrames", "equations_by_frame", "normal_equations", "registration_cost",
    "registration_frames", "robust_equations", "rows_of_frames", "spread_of", "updated_sigma",
]  # fmt: skip

# Starts and limits of (azimuth [rad], elevation [rad], range [m]): from car radars' data sheets, wide.
SIGMA_START = np.array([np.radians(0.6), np.radians(2.2), 0.20])
_SIGMA_LEAST = np.array([np.radians(0.10), np.radians(0.5), 0.05])
_SIGMA_MOST = np.array([np.radians(1.5), np.radians(5.0), 0.60])
BOUNCE_PRIOR = 0.12
_BOUNCE_MOST = 0.3
RANGE_M = (3.0, 60.0)  # over ground; nearer is the car's own clutter; farther the lidar has too few points
_RADAR_POINTS = 500  # per frame; more are redundant
SIDE_RAD = 1.25
STRAY = 200  # one in so many lidar points may lie outside the lidar's view
VIEW_MARGIN_RAD = np.radians(1.0)  # about half the elevation cell of a wide-angle radar
_FRAME = np.dtype(  # what RegistrationFrames holds of a frame beside its points
    [
        ("plane", "f8", 4),
        ("has_plane", "?"),
        ("has_elevation", "?"),
        ("velocity_mps", "f8", 3),
        ("yaw_rate_radps", "f8"),
        ("stamp_gap_s", "f8"),
        ("frame", "i8"),
    ]
)
_Rows = TypeVar("_Rows")
_LEAST_ROWS = 5  # fewer have no spread to weigh them by
_LEAST_SIGMA_RAD = np.radians(0.3)  # box edges are no better


@dataclass(frozen=True, eq=False)
class RegistrationFrames:
    """Static detections and lidar points of several frames, one frame after another."""

    radar_m: Float[np.ndarray, "M 3"]
    radar_first: Int64[np.ndarray, " F1"]
    lidar_m: Float[np.ndarray, "N 3"]
    lidar_first: Int64[np.ndarray, " F1"]
    plane: Float[np.ndarray, "F 4"]
    has_plane: Bool[np.ndarray, " F"]
    has_elevation: Bool[np.ndarray, " F"]
    velocity_mps: Float[np.ndarray, "F 3"]  # of the radar, in radar axes
    yaw_rate_radps: Float[np.ndarray, " F"]
    stamp_gap_s: Float[np.ndarray, " F"]  # radar stamp minus lidar stamp
    frame: Int64[np.ndarray, " F"]  # index into the observations given
    # Lowest and highest that the lidar ever showed, lidar axes.
    lidar_elevation_rad: Float[np.ndarray, " 2"] = field(default_factory=lambda: np.array([-1.5, 1.5]))

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.stamp_gap_s)

    def subset(self, frames: Int64[np.ndarray, " S"]) -> RegistrationFrames:
        """The same with these frames only."""
        pieces = [(self.radar_m, self.radar_first), (self.lidar_m, self.lidar_first)]
        (radar, r_first), (lidar, l_first) = (
            _pack([points[first[f] : first[f + 1]] for f in frames]) for points, first in pieces
        )
        rest = {name: getattr(self, name)[frames] for name in _FRAME.names or ()}
        return replace(self, radar_m=radar, radar_first=r_first, lidar_m=lidar, lidar_first=l_first, **rest)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Per frame, for (azimuth and range) and for elevation; unknowns: left twist, dt [s], range bias [m].

    `H` and `g` move the pose (step = -H^-1 g); `information` is that under uncertain assignment.
    """

    H: Float[np.ndarray, "2 F 8 8"]
    g: Float[np.ndarray, "2 F 8"]
    information: Float[np.ndarray, "2 F 8 8"]
    cost: Float[np.ndarray, " F"]  # minus mean log likelihood per detection
    assigned: Float[np.ndarray, " F"]  # share of detections that found a lidar point
    bounced: float  # share of the assigned that came by way of the ground
    second_moment: Float[np.ndarray, " 3"]  # of the residuals in sigmas (azimuth, elevation, range)


def registration_frames(
    observations: Sequence[Observation],
    T_lidar_radar: Float[np.ndarray, "4 4"],
    rng: np.random.Generator,
    radar_points: int = _RADAR_POINTS,
) -> RegistrationFrames:
    """Inputs of the registration, of frames with static detections and a lidar map.

    `T_lidar_radar` is a guess, accurate enough to cut the lidar map to the radar's field of view. A frame has
    at most `radar_points` detections, drawn at random.
    """
    radar, lidar, rows = [], [], []
    for index, o in enumerate(observations):
        if o.radar_velocity_mps is None:
            continue
        static = _static_detections(o, radar_points, rng)
        near = _lidar_in_view(o.lidar_map_xyz_m, T_lidar_radar)
        if len(static) < 10 or len(near) < 100:
            continue
        radar.append(static)
        lidar.append(near)
        has_plane, turn = o.ground_plane is not None, o.ego_yaw_rate_radps or 0.0  # alike all over the car
        gap_s, plane = (o.radar_stamp_ns - o.stamp_ns) * 1e-9, o.ground_plane if has_plane else np.zeros(4)
        rows.append((plane, has_plane, o.radar_has_elevation, o.radar_velocity_mps, turn, gap_s, index))
    (radar_m, radar_first), (lidar_m, lidar_first) = _pack(radar), _pack(lidar)
    return RegistrationFrames(
        radar_m, radar_first, lidar_m, lidar_first, **columns_of(rows, _FRAME),
        lidar_elevation_rad=_elevation_limits(observations),
    )  # fmt: skip


def normal_equations(
    frames: RegistrationFrames, T_lidar_radar: Float[np.ndarray, "4 4"], dt_s: float,
    sigma: Float[np.ndarray, " 3"], bounce_prior: float = BOUNCE_PRIOR, outlier: float = 1.0, stride: int = 1,
    range_bias_m: float = 0.0,
) -> NormalEquations:  # fmt: skip
    """Assign softly at this pose and linearise.

    Args:
        dt_s: time offset, stamp_lidar = stamp_radar + dt.
        sigma: of azimuth [rad], elevation [rad], range [m]; wider ones make a wider basin.
        bounce_prior: prior probability of a detection by reflection on the ground.
        outlier: weight of "no lidar point", in units of one lidar point at distance 0.
        range_bias_m: measured minus true range (the radar's own offset, and how far it sees into things).
    """
    about = (frames, T_lidar_radar, dt_s, sigma, bounce_prior, outlier, stride, range_bias_m)
    H, g, info, stats = _accumulated(*about, with_equations=True)
    seen = np.maximum(stats[:, 1], 1)
    total = stats.sum(0)
    moments = total[4:7] / np.maximum([total[2], total[7], total[2]], 1e-9)
    return NormalEquations(
        H, g, info, -stats[:, 0] / seen, stats[:, 2] / seen, float(total[3] / max(total[2], 1e-9)), moments
    )


def registration_cost(
    frames: RegistrationFrames, T_lidar_radar: Float[np.ndarray, "4 4"], dt_s: float,
    sigma: Float[np.ndarray, " 3"], outlier: float = 1.0, stride: int = 1, range_bias_m: float = 0.0,
) -> Float[np.ndarray, " F"]:  # fmt: skip
    """The cost of `normal_equations` alone, without ground bounces: half the work, to compare poses and offsets."""
    about = (frames, T_lidar_radar, dt_s, sigma, 0.0, outlier, stride, range_bias_m)
    stats = _accumulated(*about, with_equations=False)[-1]
    return np.asarray(-stats[:, 0] / np.maximum(stats[:, 1], 1))


def _accumulated(
    frames: RegistrationFrames, T_lidar_radar: np.ndarray, dt_s: float, sigma: np.ndarray,
    bounce_prior: float, outlier: float, stride: int, range_bias_m: float, *, with_equations: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """H (2 F 8 8), g (2 F 8), information (2 F 8 8) and statistics (F STATS) of the compiled loop."""
    F = frames.count
    H, info = np.zeros((F, 2, 8, 8)), np.zeros((F, 2, 8, 8))
    g, stats = np.zeros((F, 2, 8)), np.zeros((F, STATS))
    accumulate_frames(
        np.ascontiguousarray(T_lidar_radar, np.float64), frames.stamp_gap_s + dt_s, range_bias_m,
        frames.velocity_mps, frames.yaw_rate_radps, frames.radar_m, frames.radar_first, frames.lidar_m,
        frames.lidar_first, frames.plane, frames.has_plane, frames.has_elevation,
        _comparable_elevations(frames.lidar_elevation_rad, float(sigma[1])), np.asarray(sigma, np.float64),
        outlier, bounce_prior, stride, RANGE_M[1] + 5.0, with_equations, H, g, info, stats,
    )  # fmt: skip
    return H.swapaxes(0, 1), g.swapaxes(0, 1), info.swapaxes(0, 1), stats


def updated_sigma(
    equations: NormalEquations, sigma: Float[np.ndarray, " 3"], bounce_prior: float
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Sigmas and bounce probability from the assigned residuals, within plausible limits (one EM step)."""
    # EM shrinks wide sigmas slowly (every lidar point within reach is a partner): take twice its step in logarithms.
    shown = sigma * np.maximum(equations.second_moment, 1e-6)
    bounce = float(np.clip(equations.bounced, 0.01, _BOUNCE_MOST)) if bounce_prior > 0 else 0.0
    return np.clip(shown, _SIGMA_LEAST, _SIGMA_MOST), bounce


def _elevation_limits(observations: Sequence[Observation]) -> np.ndarray:
    """Lowest and highest elevation [rad] of lidar maps, without a few stray points."""
    low, high = [], []
    for o in observations:
        p = o.lidar_map_xyz_m
        if len(p) >= 100:
            angle = np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))
            few = np.partition(angle, (len(p) // STRAY, len(p) - 1 - len(p) // STRAY))
            low.append(few[len(p) // STRAY])
            high.append(few[-1 - len(p) // STRAY])
    # The extremes over the frames: no single street shows all of the field of view.
    return np.array([min(low), max(high)], np.float64) if low else np.array([-1.5, 1.5])


def _comparable_elevations(limits_rad: np.ndarray, sigma_rad: float) -> np.ndarray:
    """Tangents of the limits between which a detection's elevation can be compared with the lidar's.

    Detections outside the lidar's field of view would be matched to its edge, always from the same side: a
    bias.
    """
    margin = VIEW_MARGIN_RAD + min(2 * sigma_rad, 0.25 * float(limits_rad[1] - limits_rad[0]))
    return np.tan(np.clip(limits_rad + np.array([margin, -margin]), -1.5, 1.5))


def _static_detections(o: Observation, most: int, rng: np.random.Generator) -> np.ndarray:
    """Static detections at useful ranges; at most `most`, evenly over azimuth."""
    r = np.hypot(o.radar_xyz_m[:, 0], o.radar_xyz_m[:, 1])
    azimuth = np.arctan2(o.radar_xyz_m[:, 1], o.radar_xyz_m[:, 0])
    use = np.flatnonzero(
        (o.radar_motion == 0) & (r > RANGE_M[0]) & (r < RANGE_M[1]) & (np.abs(azimuth) < SIDE_RAD)
    )
    if len(use) > most:
        bins = np.clip((azimuth[use] + SIDE_RAD) / (2 * SIDE_RAD) * 24, 0, 23).astype(int)
        weight = 1 / np.sqrt(np.bincount(bins, minlength=24)[bins])
        use = np.sort(rng.choice(use, most, replace=False, p=weight / weight.sum()))
    return o.radar_xyz_m[use].astype(np.float64)


def _lidar_in_view(lidar: np.ndarray, T_lidar_radar: np.ndarray) -> np.ndarray:
    """Lidar points that the radar might see from anywhere near the guess."""
    p = transform_points(inverse(T_lidar_radar), lidar.astype(np.float64))
    r = np.hypot(p[:, 0], p[:, 1])
    keep = (r < RANGE_M[1] + 3) & (r > 1.5) & (np.abs(np.arctan2(p[:, 1], p[:, 0])) < SIDE_RAD + 0.2)
    return lidar[keep].astype(np.float64)


def _pack(pieces: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Points one after another, and where each frame begins."""
    first = np.concatenate([[0], np.cumsum([len(p) for p in pieces], dtype=np.int64)]).astype(np.int64)
    return (np.concatenate(pieces) if len(pieces) else np.zeros((0, 3))), first


def rows_of_frames(rows: _Rows, frames: Int64[np.ndarray, " S"]) -> _Rows:
    """The rows of these frames, which are renumbered in the given order."""
    held: Any = rows
    place = np.full(int(max(held.frame.max(initial=-1), frames.max(initial=-1))) + 1, -1, np.int64)
    place[frames] = np.arange(len(frames))
    index = np.flatnonzero(place[held.frame] >= 0)
    return replace(take_rows(held, index), frame=place[held.frame[index]])


def spread_of(residual: Float[np.ndarray, " B"]) -> float:
    """Robust standard deviation."""
    return float(1.4826 * np.median(np.abs(residual - np.median(residual))))


def equations_by_frame(
    weight: Float[np.ndarray, " B"],
    residual: Float[np.ndarray, " B"],
    J: Float[np.ndarray, "B P"],
    frame: Int64[np.ndarray, " B"],
    frames: int,
) -> tuple[Float[np.ndarray, "F P P"], Float[np.ndarray, "F P"]]:
    """Information and gradient of the weighted squares, per frame."""
    P = J.shape[1]
    H, g = np.zeros((frames, P, P)), np.zeros((frames, P))
    np.add.at(H, frame, weight[:, None, None] * J[:, :, None] * J[:, None, :])
    np.add.at(g, frame, (weight * residual)[:, None] * J)
    return H, g


def robust_equations(
    residual: Float[np.ndarray, " B"],
    J: Float[np.ndarray, "B P"],
    frame: Int64[np.ndarray, " B"],
    frames: int,
) -> tuple[Float[np.ndarray, "F P P"], Float[np.ndarray, "F P"], float]:
    """Per frame, information and gradient of the robust (Cauchy) cost of angles, and the residuals' own sigma [rad].

    Equations are zero, and sigma is NaN, where residuals are too few to show their spread.
    """
    if len(residual) < _LEAST_ROWS:
        none = np.zeros(0)
        return *equations_by_frame(none, none, J[:0], frame[:0], frames), float("nan")
    sigma = max(spread_of(residual), _LEAST_SIGMA_RAD)
    weight = 1 / (1 + (residual / (2 * sigma)) ** 2) / sigma**2
    return *equations_by_frame(weight, residual, J, frame, frames), sigma

"""Static elevations compared with lidar heights: direct, or displaced towards the mirror image in the road.

For an object of height h over the road, a radar measures the elevation of the object, of its image (height
-h), or, if it cannot resolve both, a value in between. This displacement is a share in (0, 1] of the distance
to the image, and changes from scan to scan. So detections of high objects are too low on average. Matching
them with lidar points rotates the estimated radar upwards, by degrees on some days. Detections on the road
are not displaced, and the displacement grows with h / r, whereas pitch affects all of them equally.

Each detection is drawn from the lidar points near its azimuth and range: direct, the image in the road,
displaced by a uniform share, or from anywhere (more often where the lidar sees bare road). The shares of
these and the noise of elevations are unknowns, like pitch and roll. Tall objects are left out, because radars
measure their lower parts, leaves, or objects behind. A detection is compared at any elevation, so that no cut
causes a bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int64
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.special import ndtr

from pipeline.objective.radar.registration import rows_of_frames
from pipeline.objective.radar.vehicle_boxes import median_of_rows
from pipeline.rig.se3 import inverse, to_spherical, transform_points
from schemas.observations import Observation

__all__ = ["Heights", "displaced_heights"]

# Errors of pitch at the true height on 12 simulated days of six dirty rigs and three of clean ones (seeds 120 to 131,
# 40 frames), and on two days that were not simulated here (-.3 both; one is of a given calibration that is doubtful by
# .25): .20 deg RMS. On 28 more dirty days (seeds 132 to 159) .21, .03 in the mean, where the frames' scatter gave .07.
# Other windows and heights up to 3.5 m: .19 to .30 RMS.
_PITCH_FLOOR_RAD = np.radians(0.20)
_RANGE_M = (5.0, 60.0)
_TALLEST_M = 2.0  # cars, rails, kerbs
_NEAR = np.array([np.radians(1.0), 0.6])  # azimuth and range about a detection: three sigmas of car radars
_LEAST_POINTS, _POINTS = 2, 8  # lidar points: needed near a detection, and taken of them
_MOST = 8000  # detections of a day
_FEWEST, _FEWEST_FRAMES = 200, 5
# Pitch, roll [rad], logit of the displaced, log sigma; logits of those from anywhere: where things stand, on bare road;
# of images.
_START = np.array([0.0, 0.0, -0.5, np.log(np.radians(1.5)), -3.0, -3.0, -3.0])
_BOUNDS = [
    (-0.1, 0.1),
    (-0.2, 0.2),
    (-5.0, 3.0),
    (np.log(np.radians(0.3)), np.log(np.radians(6.0))),
    (-6.0, 1.0),
    (-6.0, 6.0),
    (-6.0, 3.0),
]
_STEP = np.array([1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3])
# Over which detections from anywhere are spread: about things a radar's whole view, so that few of the displaced are
# taken for such; over bare road what radars see there and lidars do not, as the elevations themselves are spread.
_VIEW_RAD, _LEAST_VIEW_RAD = np.radians(24.0), np.radians(5.0)
_NORMAL = np.sqrt(2 * np.pi)
_DISPLACED, _ANYWHERE = 2, 3  # of the four kinds of detections
_BELOW_M = 0.3  # under the road: clearly below it
_NARROWEST = 0.3  # sigmas: nearer to its image a thing is one with it


@dataclass(frozen=True, eq=False)
class HeightScores:
    """Normal equations of each frame for the radar's own pitch."""

    information: Float[np.ndarray, " D"]
    score: Float[np.ndarray, " D"]  # gradient of the cost; the day's sum is 0
    frame: Int64[np.ndarray, " D"]  # index into the observations given


@dataclass(frozen=True, eq=False)
class Heights:
    """The radar's own pitch from static elevations, at the pose that they were measured with."""

    turn_rad: float  # by which they would turn the radar, nose down positive
    T_lidar_radar: Float[np.ndarray, "4 4"]  # before that turn
    displaced: float  # share of the detections
    explained: float  # share of them that come from where the lidar sees something
    below: float  # share of them that lie below the road because they are displaced, not by noise, image or clutter
    per_height_radpm: float  # by how much further it turns a radar that is taken for so much higher
    frames: HeightScores

    @property
    def floor_rad(self) -> float:
        """Sigma of pitch that more frames do not reduce: where many come from anywhere, others may be wrong too."""
        return float(_PITCH_FLOOR_RAD / self.explained)

    def seen_low(self, below: Float[np.ndarray, " D"]) -> float:
        """Sigma of the share of their height by which objects are measured too low.

        It is at most the given share of detections below the road (of moving frames), and at most twice the
        mixture's share of displaced ones there, because as many are displaced but still above the road.
        """
        return min(float(np.mean(below)), 2 * self.below)

    def of_frames(self, frames: Int64[np.ndarray, " S"]) -> Heights:
        """The part of some observations, which are renumbered in the given order."""
        return replace(self, frames=rows_of_frames(self.frames, frames))


@dataclass(frozen=True, eq=False)
class _Detections:
    range_m: Float[np.ndarray, " N"]
    azimuth: Float[np.ndarray, " N"]
    # Of the detection over the road where it stands, seen from the radar's height.
    elevation: Float[np.ndarray, " N"]
    mirror: Float[np.ndarray, "N J"]  # ... of lidar points there
    frame: Int64[np.ndarray, " N"]


def displaced_heights(
    observations: Sequence[Observation],
    T_lidar_radar: Float[np.ndarray, "4 4"],
    dt_s: float,
    rng: np.random.Generator,
) -> Heights | None:
    """Pitch by the mixture; None if there are too few elevations, road points or objects on the road.

    Args:
        observations: any frames.
        T_lidar_radar: a pose, accurate to some degrees.
        dt_s: time offset, stamp_lidar = stamp_radar + dt.
        rng: selects detections and lidar points if there are many.
    """
    use = [
        k
        for k, o in enumerate(observations)
        if o.radar_has_elevation
        and o.radar_velocity_mps is not None
        and o.ground_plane is not None
        and o.lidar_map_is_ground.any()
    ]
    each = [_detections(observations[k], k, T_lidar_radar, dt_s, _MOST // len(use), rng) for k in use]
    if len(each) < _FEWEST_FRAMES or sum(len(d.frame) for d in each) < _FEWEST:
        return None
    day = _Detections(
        *(np.concatenate(column) for column in zip(*(vars(d).values() for d in each), strict=True))
    )
    kinds = _Kinds(day)
    x = minimize(lambda x: -_log_likelihood(kinds, x).sum(), _START, method="L-BFGS-B", bounds=_BOUNDS).x
    if any(abs(x[k]) >= _BOUNDS[k][1] for k in (0, 1)):  # the end of a search, not what was measured
        return None
    per_height, scores = _scores(kinds, x)
    each_kind, turned = _densities(kinds, x)
    kind = each_kind / each_kind.sum(0)
    below = float(np.mean(kind[_DISPLACED] * (turned < -_BELOW_M / day.range_m)))
    explained = float(1 - kind[_ANYWHERE].mean())
    return Heights(float(x[0]), T_lidar_radar, _share(x[2]), explained, below, per_height, scores)


class _Kinds:
    """Densities of a day's detections by kind; the last few are kept, for numerical derivatives ask for them again."""

    def __init__(self, day: _Detections) -> None:
        self.day = day
        self.stands = day.mirror.any(1)  # the lidar shows an object there, not bare road
        # Points of bare road have no height: one stands for all of a detection's.
        self.groups = (self.stands, day.mirror[self.stands]), (~self.stands, np.zeros((1, 1)))
        self.of = lru_cache(maxsize=4)(self._of)

    def _of(self, pitch: float, roll: float, log_sigma: float) -> tuple[np.ndarray, np.ndarray]:
        """Densities as direct, image and displaced (3 N), and the rotated elevations (N)."""
        day, sigma = self.day, float(np.exp(log_sigma))
        turned = day.elevation - pitch * np.cos(day.azimuth) + roll * np.sin(day.azimuth)
        found = np.empty((3, len(turned)))
        for rows, mirror in self.groups:
            z, m = turned[rows, None] / sigma, mirror / sigma
            half = np.maximum(m, _NARROWEST)
            found[0, rows], found[1, rows] = (
                (np.exp(-0.5 * (z + sign * m) ** 2) / _NORMAL).mean(1) for sign in (-1.0, 1.0)
            )
            found[2, rows] = ((ndtr(z + half) - ndtr(z - half)) / (2 * half)).mean(1)
        return found, turned


def _log_likelihood(kinds: _Kinds, x: np.ndarray) -> np.ndarray:
    """Log likelihood of each detection, for unknowns in the order of _START."""
    return np.asarray(np.log(_densities(kinds, x)[0].sum(0)))


def _densities(kinds: _Kinds, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Density of each detection as direct, image, displaced and from anywhere (4 N), and its rotated elevation (N)."""
    displaced, image, sigma = _share(x[2]), _share(x[6]), float(np.exp(x[3]))
    stands = kinds.stands
    anywhere = np.where(stands, _share(x[4]), _share(x[5]))
    view_rad = np.where(stands, _VIEW_RAD, max(np.sqrt(12.0) * np.std(kinds.day.elevation), _LEAST_VIEW_RAD))
    of_kind, turned = kinds.of(float(x[0]), float(x[1]), float(x[3]))
    shares = ((1 - image) * (1 - displaced), image, (1 - image) * displaced)
    near = [share * (1 - anywhere) * kind / sigma for share, kind in zip(shares, of_kind, strict=True)]
    return np.stack([*near, anywhere / view_rad]), turned


def _share(logit: float) -> float:
    return float(1 / (1 + np.exp(-logit)))


def _scores(kinds: _Kinds, x: np.ndarray) -> tuple[float, HeightScores]:
    """Derivative of pitch by the radar's height, and information and score of pitch with the other unknowns eliminated.

    The information is scaled to the scatter of the frames.
    """
    day, steps = kinds.day, np.diag(_STEP)
    S = np.stack(
        [(_log_likelihood(kinds, x + s) - _log_likelihood(kinds, x - s)) / (2 * s.sum()) for s in steps], 1
    )
    frame, row = np.unique(day.frame, return_inverse=True)
    H, g = S.T @ S, np.zeros((len(frame), len(x)))
    np.add.at(g, row, S)
    others = np.linalg.lstsq(H[1:, 1:], H[1:, 0], rcond=None)[0]
    own = g[:, 0] - g[:, 1:] @ others
    information = float(H[0, 0] - H[0, 1:] @ others)
    # A radar taken for higher sees all of a range r higher by 1 / r, as one that is turned up does by cos(azimuth).
    higher = -S[:, 0] / (day.range_m * np.cos(day.azimuth))
    per_height = -float((S[:, 0] - S[:, 1:] @ others) @ higher) / information
    # Detections of a thing err alike, and so do frames that show it: in pairs of frames.
    pairs = np.add.reduceat(own, np.arange(0, len(own), 2))
    alike = max(1.0, float(pairs @ pairs) / information)
    count = np.bincount(row) / len(row)
    scores = HeightScores(information * count / alike, -(own - own.mean()) / alike, frame)
    return per_height, scores


def _detections(
    o: Observation, frame: int, T_lidar_radar: np.ndarray, dt_s: float, most: int, rng: np.random.Generator
) -> _Detections:
    """Static detections of one frame with nearby lidar points, none of which belongs to a tall object."""
    assert o.radar_velocity_mps is not None
    assert o.ground_plane is not None
    moved = o.radar_velocity_mps * ((o.radar_stamp_ns - o.stamp_ns) * 1e-9 + dt_s)
    radar = o.radar_xyz_m[o.radar_motion == 0].astype(np.float64)
    radar = radar[rng.permutation(len(radar))]
    range_m = np.linalg.norm(radar, axis=1)
    radar = radar[(range_m > _RANGE_M[0]) & (range_m < _RANGE_M[1])][:most]
    lidar, plane = o.lidar_map_xyz_m.astype(np.float64), o.ground_plane
    over = lidar @ plane[:3] + plane[3]
    aer = to_spherical(radar)
    there = to_spherical(transform_points(inverse(T_lidar_radar), lidar) - moved)
    near = cKDTree(there[:, [0, 2]] / _NEAR).query_ball_point(aer[:, [0, 2]] / _NEAR, 1.0)
    seen = transform_points(T_lidar_radar, radar + moved) @ plane[:3] + plane[3]
    is_road, rows = o.lidar_map_is_ground.astype(bool), []
    for k, hits in enumerate(near):
        if len(hits) >= _LEAST_POINTS:
            road, stands = over[hits][is_road[hits]], over[hits][~is_road[hits]]
            foot = float(median_of_rows(road)) if len(road) else 0.0
            if stands.max(initial=0.0) - foot < _TALLEST_M:
                high = (
                    np.maximum(rng.choice(stands, _POINTS) - foot, 0.0) if len(stands) else np.zeros(_POINTS)
                )
                rows.append((aer[k, 2], aer[k, 0], (seen[k] - foot) / aer[k, 2], *(high / aer[k, 2])))
    table = np.array(rows).reshape(-1, 3 + _POINTS)
    number = np.full(len(table), frame, np.int64)
    return _Detections(table[:, 0], table[:, 1], table[:, 2], table[:, 3:], number)

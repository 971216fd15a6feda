"""Targets that both sensors of a pair see, from their views of the day: what a pair is certified by.

What an error of the pose costs depends on where it puts things. A camera that looks to the left sees nothing before the
lidar, where its pitch is a roll: certified there, it would be certified by what it never sees. So targets lie where the
views overlap at the prior: the camera's image through CameraInfo, and directions in which the lidar has points and the
radar detections, holes of the scene filled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from pipeline.extrinsics.checks import FailedCheck
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.cameras import Camera, camera_of
from pipeline.geometry.se3 import transform_points
from pipeline.geometry.spherical import from_spherical, to_spherical, wrap_angle
from pipeline.geometry.targets import DEFAULT_TARGETS
from schemas.calibrations import FRAMES_OF_PAIR
from schemas.observations import Observation

__all__ = ["seen_targets", "unseen_failure", "views_of"]

View = Callable[[Float[np.ndarray, "*batch 3"]], Bool[np.ndarray, "*batch"]]

_BIN_RAD = np.radians(2.0)
_FRAMES, _POINTS = 20, 2000  # of the day, and of each of them: enough for a view's borders
_FEWEST = 100  # points that show a view; with fewer the sensor passes for one that sees everything
# Of the density that a typical point has about it: below it a direction is not in view. De-skewing smears the border of
# a sweep by ten degrees at highway speeds, thinner than the view by more than this.
_DENSE = 0.25
_STRAY = 0.002  # share of points that may lie above a view, and below it
_HOLE_RAD = np.radians(
    20.0
)  # a wider gap between directions with points is the view's end, one such gap at most
_AZIMUTHS = np.radians(np.arange(-179.5, 180.0))
_ELEVATIONS = np.radians(np.array(sorted(range(-40, 41), key=abs), np.float64))  # the flattest first
_SPREAD, _, _RANGES_M = to_spherical(DEFAULT_TARGETS).T  # azimuths about the middle of what both see
_WIDE_RAD = np.radians(12.5)  # half-width from which they lie as far apart as that


def views_of(observations: Sequence[Observation]) -> dict[str, View]:
    """By sensor, which points of its own frame it sees; a sensor without data of its own is left out."""
    some = observations[:: max(len(observations) // _FRAMES, 1)]
    clouds = {
        "lidar": [o.lidar_map_xyz_m for o in some if "lidar" in o.sensors],
        "radar": [o.radar_xyz_m for o in some if "radar" in o.sensors],
    }
    views = {
        sensor: _of_points(np.concatenate([c[:: max(len(c) // _POINTS, 1)] for c in own]).astype(np.float64))
        for sensor, own in clouds.items()
        if sum(len(c) for c in own) >= _FEWEST
    }
    camera = next((camera_of(o) for o in some if "camera" in o.sensors), None)
    return views if camera is None else views | {"camera": _of_camera(camera)}


def seen_targets(pair: str, prior: Prior, views: dict[str, View]) -> Float[np.ndarray, "3 3"] | None:
    """Three targets 15, 25 and 40 m away, in the child's frame; None where the two see no direction in common.

    About the middle of what both see, as far apart as before cars that look ahead, or closer where the views are
    narrow; as level as the views allow.
    """
    parent, child = FRAMES_OF_PAIR[pair]
    # Near and far: a sensor a metre aside sees them two to four degrees apart.
    ranges_m = [_RANGES_M.min(), _RANGES_M.max()]
    points = from_spherical(np.stack(np.meshgrid(_AZIMUTHS, _ELEVATIONS, ranges_m, indexing="ij"), -1))
    seen = np.ones(points.shape[:2], bool)
    for sensor, T in ((child, np.eye(4)), (parent, prior.of(pair))):
        if sensor in views:
            seen &= views[sensor](transform_points(T, points)).all(axis=2)
    columns = np.flatnonzero(seen.any(axis=1))
    if not len(columns):
        return None
    azimuth = _AZIMUTHS[columns]
    # Of a sensor that sees all around, ahead is as good as any.
    around = len(columns) == len(_AZIMUTHS)
    middle = 0.0 if around else float(np.angle(np.exp(1j * azimuth).mean()))
    apart = np.abs(wrap_angle(azimuth - middle))
    narrow = min(1.0, float(np.quantile(apart, 0.9)) / _WIDE_RAD)
    targets = []
    for offset, range_m in zip(_SPREAD * narrow, _RANGES_M, strict=True):
        away = wrap_angle(azimuth - (middle + offset))
        k = int(np.argmin(np.abs(away)))
        # Where both see it, a target is where it should be and not on the grid.
        target = middle + offset if abs(away[k]) <= _BIN_RAD else azimuth[k]
        targets.append([target, _ELEVATIONS[int(np.argmax(seen[columns[k]]))], range_m])
    return from_spherical(np.array(targets))


def unseen_failure(pair: str) -> FailedCheck:
    """Why a pair without any common direction cannot be accepted."""
    parent, child = FRAMES_OF_PAIR[pair]
    return FailedCheck(f"{parent} and {child} see no direction in common at the prior: nothing to certify")


def _of_camera(camera: Camera) -> View:
    def seen(points: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch"]:
        uv, valid = camera.project(points)
        return valid & camera.contains(np.where(np.isfinite(uv), uv, -1.0))

    return seen


def _of_points(points: Float[np.ndarray, "N 3"]) -> View:
    """Azimuths beside the widest gap without points, between lowest and highest elevation; any where all are level."""
    azimuth, elevation = to_spherical(points)[:, :2].T
    bins = round(2 * np.pi / _BIN_RAD)
    count = np.bincount(_bin(azimuth, bins), minlength=bins)
    filled = _without_holes(count > _DENSE * np.sum(count**2) / len(points))
    low, high = np.quantile(elevation, [_STRAY, 1 - _STRAY])
    flat = high - low < 1e-6

    def seen(at: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch"]:
        az, el, _ = np.moveaxis(to_spherical(at), -1, 0)
        return filled[_bin(az, bins)] & (flat | ((el >= low) & (el <= high)))

    return seen


def _without_holes(filled: Bool[np.ndarray, " B"]) -> Bool[np.ndarray, " B"]:
    """Bins of a circle with all gaps filled but the widest, and that as well where it is a hole of the scene."""
    at = np.flatnonzero(filled)
    if not len(at):
        return np.ones_like(filled)
    gaps = np.diff(at, append=at[0] + len(filled)) - 1
    widest = int(np.argmax(gaps))
    out = np.ones_like(filled)
    if gaps[widest] * _BIN_RAD > _HOLE_RAD:
        out[(at[widest] + 1 + np.arange(gaps[widest])) % len(filled)] = False
    return out


def _bin(azimuth: np.ndarray, bins: int) -> np.ndarray:
    return np.asarray((azimuth + np.pi) / _BIN_RAD, np.int64) % bins

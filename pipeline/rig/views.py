"""Field of view of a sensor: image area of a camera (CameraInfo), directions with points of a lidar or radar.

Gaps due to the scene are filled. A radar without elevation has no limits in elevation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from pipeline.rig.cameras import Camera
from pipeline.rig.spherical import to_spherical

__all__ = ["FRAMES", "View", "view_of_camera", "view_of_clouds"]

# Mask of the points in a sensor's frame that it can see.
View = Callable[[Float[np.ndarray, "*batch 3"]], Bool[np.ndarray, "*batch"]]

FRAMES = 20  # per day, enough for the borders of a view
_POINTS = 2000  # per frame
_BIN_RAD = np.radians(2.0)
_FEWEST = 100  # minimum number of points for a view
# Share of the median point density; directions below it are outside the view. De-skewing spreads the border
# of a sweep over ten degrees at highway speeds, with a lower density than this.
_DENSE = 0.25
_STRAY = 0.002  # share of points that may lie above a view, and below it
# A wider gap between directions with points is the end of the view; a view has at most one.
_HOLE_RAD = np.radians(20.0)


def view_of_camera(camera: Camera) -> View:
    """Mask of points that project into the image."""

    def seen(points: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch"]:
        uv, valid = camera.project(points)
        return valid & camera.contains(np.where(np.isfinite(uv), uv, -1.0))

    return seen


def view_of_clouds(clouds: Sequence[Float[np.ndarray, "_ 3"]]) -> View | None:
    """View of a lidar or radar from sweeps or scans over its day [m]; None if there are too few points."""
    if sum(len(c) for c in clouds) < _FEWEST:
        return None
    return _of_points(np.concatenate([c[:: max(len(c) // _POINTS, 1)] for c in clouds]).astype(np.float64))


def _of_points(points: Float[np.ndarray, "N 3"]) -> View:
    """Azimuths outside the widest gap, lowest to highest elevation (no limits if all points are level)."""
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
    """Bins of a circle with all gaps filled, except the widest unless it is due to the scene."""
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

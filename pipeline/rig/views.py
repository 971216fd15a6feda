"""What a sensor sees: a camera's image through CameraInfo, directions in which a lidar or a radar has points.

Holes of the scene are filled. A radar without elevation sees any.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry.cameras import Camera
from pipeline.geometry.spherical import to_spherical

__all__ = ["FRAMES", "View", "view_of_camera", "view_of_clouds"]

# Which points of its own frame a sensor sees.
View = Callable[[Float[np.ndarray, "*batch 3"]], Bool[np.ndarray, "*batch"]]

FRAMES = 20  # of a day, enough for a view's borders
_POINTS = 2000  # of each of them
_BIN_RAD = np.radians(2.0)
_FEWEST = 100  # points that show a view
# Of the density that a typical point has about it: below it a direction is not in view. De-skewing smears the border of
# a sweep by ten degrees at highway speeds, thinner than the view by more than this.
_DENSE = 0.25
_STRAY = 0.002  # share of points that may lie above a view, and below it
# A wider gap between directions with points is the view's end, one such gap at most.
_HOLE_RAD = np.radians(20.0)


def view_of_camera(camera: Camera) -> View:
    """Points that project into the image."""

    def seen(points: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch"]:
        uv, valid = camera.project(points)
        return valid & camera.contains(np.where(np.isfinite(uv), uv, -1.0))

    return seen


def view_of_clouds(clouds: Sequence[Float[np.ndarray, "_ 3"]]) -> View | None:
    """What a lidar or radar sees by some of its day's sweeps or scans; None where they are too few points to tell.

    Args:
        clouds: evenly spread over the day, FRAMES of them at best; in the sensor's frame [m].
    """
    if sum(len(c) for c in clouds) < _FEWEST:
        return None
    return _of_points(np.concatenate([c[:: max(len(c) // _POINTS, 1)] for c in clouds]).astype(np.float64))


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

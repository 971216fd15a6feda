"""Targets in view of both sensors of a pair, at which a pair is certified.

The effect of a pose error depends on the direction of a target. For a camera that looks to the left, a target
ahead of the lidar would turn its pitch into a roll: it would be certified at a target that it never sees. So
targets are placed where the views overlap at the prior. The view of a camera is its image by CameraInfo. The
view of a lidar or radar is the set of directions in which it has points or detections on the day, with holes
of the scene filled.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipeline.rig.cameras import camera_of
from pipeline.rig.checks import FailedCheck
from pipeline.rig.estimates import Prior
from pipeline.rig.overlap import FRAMES, View, view_of_camera, view_of_clouds
from pipeline.rig.se3 import transform_points
from pipeline.rig.spherical import from_spherical, to_spherical, wrap_angle
from pipeline.rig.targets import DEFAULT_TARGETS
from schemas.calibrations import FRAMES_OF_PAIR
from schemas.observations import Observation

__all__ = ["seen_targets", "targets_of", "unseen_failure", "views_of"]

_BIN_RAD = np.radians(2.0)
_AZIMUTHS = np.radians(np.arange(-179.5, 180.0))
_ELEVATIONS = np.radians(np.array(sorted(range(-40, 41), key=abs), np.float64))  # the flattest first
_SPREAD, _, _RANGES_M = to_spherical(DEFAULT_TARGETS).T  # azimuths about the middle of what both see
_WIDE_RAD = np.radians(12.5)  # half-width from which they lie as far apart as that


def views_of(observations: Sequence[Observation]) -> dict[str, View]:
    """View of each sensor, for points in its own frame; a sensor without data is left out."""
    some = observations[:: max(len(observations) // FRAMES, 1)]
    clouds = {
        "lidar": [o.lidar_map_xyz_m for o in some if "lidar" in o.sensors],
        "radar": [o.radar_xyz_m for o in some if "radar" in o.sensors],
    }
    views = {sensor: view_of_clouds(own) for sensor, own in clouds.items()}
    camera = next((camera_of(o) for o in some if "camera" in o.sensors), None)
    views["camera"] = None if camera is None else view_of_camera(camera)
    return {sensor: view for sensor, view in views.items() if view is not None}


def seen_targets(pair: str, prior: Prior, views: dict[str, View]) -> Float[np.ndarray, "3 3"] | None:
    """Targets of a pair of camera, lidar and radar; a sensor without a view is taken to see everything."""
    parent, child = FRAMES_OF_PAIR[pair]
    return targets_of(prior.of(pair), views.get(parent), views.get(child))


def targets_of(
    T_parent_child: Float[np.ndarray, "4 4"], parent: View | None, child: View | None
) -> Float[np.ndarray, "3 3"] | None:
    """Three targets 15, 25 and 40 m away, in the child's frame; None if the views do not overlap.

    They surround the middle of the common view, as level as the views allow. Their spacing is that of sensors
    that look ahead, or less in narrow views. A view None sees everything.
    """
    # Near and far: a sensor a metre aside sees them two to four degrees apart.
    ranges_m = [_RANGES_M.min(), _RANGES_M.max()]
    points = from_spherical(np.stack(np.meshgrid(_AZIMUTHS, _ELEVATIONS, ranges_m, indexing="ij"), -1))
    seen = np.ones(points.shape[:2], bool)
    for view, T in ((child, np.eye(4)), (parent, T_parent_child)):
        if view is not None:
            seen &= view(transform_points(T, points)).all(axis=2)
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
    """Reason why a pair without overlapping views cannot be accepted."""
    parent, child = FRAMES_OF_PAIR[pair]
    return FailedCheck(f"{parent} and {child} see no direction in common at the prior: nothing to certify")

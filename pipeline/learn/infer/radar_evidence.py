"""Lidar-radar evidence of one frame at any pose: detections under the density of the lidar's object points.

The likelihood of the network's matcher (`network.occupancy_matcher`) with its learned widths, floor and weights. A
network looks at it in one frame, about one angle after the other; here all frames of a day are scored at one pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32, Int

from pipeline.learn.sample.rendering import FrameSensors
from pipeline.rig.se3 import to_spherical

__all__ = ["RadarEvidence"]

_MATCHER = "core.radar_matcher."  # names of its weights
_USUAL_M = 20.0  # at this range an object point counts once: beams thin out with the square of the range
_NEAR_M = 0.1  # nearer ahead of the lidar, and behind it, a detection shows nothing
_FARTHEST = 18.0  # squared widths from which on the kernel is nothing beside the floor


@dataclass(frozen=True, eq=False)
class RadarEvidence:
    """One frame: detections, and object points as places of a density in azimuth, elevation and range.

    Args:
        detections_m: radar frame.
        objects: lidar frame, each coordinate in widths of the kernel; sorted by range.
        width: of the kernel [rad, rad, m]; that of elevation is infinite for a radar that measures none.
        floor: density of clutter.
        travel: twist per second of the radar in its own axes [rad/s, m/s].
        lag_s: by how much later than the scan the sweep was taken, by their stamps.
    """

    detections_m: Float[np.ndarray, "M 3"]
    weight: Float[np.ndarray, " M"]
    objects: Float[np.ndarray, "L 3"]
    density: Float[np.ndarray, " L"]
    width: Float[np.ndarray, " 3"]
    floor: float
    travel: Float[np.ndarray, " 6"] = field(default_factory=lambda: np.zeros(6))
    lag_s: float = 0.0

    @classmethod
    def of(
        cls, sensors: FrameSensors, objects_m: Float32[np.ndarray, "L 3"], learned: Mapping[str, np.ndarray]
    ) -> RadarEvidence | None:
        """Of a frame and its object points, with a network's learned numbers; None if it has no such matcher."""
        if _MATCHER + "log_width" not in learned:
            return None
        width = np.exp(learned[_MATCHER + "log_width"].ravel().astype(np.float64))
        width[1] = width[1] if sensors.radar_has_elevation else np.inf
        places = to_spherical(objects_m.astype(np.float64))
        places = places[np.argsort(places[:, 2], kind="stable")]
        worth = sensors.radar_features @ learned[_MATCHER + "weigh.weight"].ravel()
        return cls(
            sensors.radar_xyz_m.astype(np.float64),
            2 / (1 + np.exp(-(worth + learned[_MATCHER + "weigh.bias"].ravel()).astype(np.float64))),
            places / width, np.square(places[:, 2] / _USUAL_M), width,
            float(np.exp(learned[_MATCHER + "log_floor"].ravel()[0])),
        )  # fmt: skip

    @property
    def kinds(self) -> Int[np.ndarray, " 1"]:
        """One kind of evidence."""
        return np.zeros(1, int)

    def score(
        self, T_lidar_radar: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, " 1"], Float[np.ndarray, "1 6"]]:
        """Mean log-likelihood of the detections, and its gradient by a left twist (per rad, per m)."""
        found, seen = np.zeros(7), (self.detections_m, self.weight, self.objects, self.density)
        _score(*seen, 1 / self.width, self.floor, T_lidar_radar[:3], found)
        return found[:1], found[None, 1:]


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def _score(detections, weight, objects, density, scale, floor, T, found):  # noqa: ANN001, ANN202 - compiled
    reach = np.sqrt(_FARTHEST)
    total, ranges = 0.0, objects[:, 2].copy()
    for n in range(len(detections)):
        total += weight[n]
        a, b, c = detections[n]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        mass, by_azimuth, by_elevation, by_range = floor, 0.0, 0.0, 0.0
        if x > _NEAR_M:
            level = np.sqrt(x * x + y * y)
            far = np.sqrt(level * level + z * z)
            azimuth, elevation = np.arctan2(y, x) * scale[0], np.arctan2(z, level) * scale[1]
            away = far * scale[2]
            for k in range(np.searchsorted(ranges, away - reach), len(objects)):
                d_range = objects[k, 2] - away
                if d_range > reach:
                    break
                d_azimuth = objects[k, 0] - azimuth
                if d_azimuth * d_azimuth > _FARTHEST:
                    continue
                d_elevation = objects[k, 1] - elevation
                apart = d_azimuth * d_azimuth + d_elevation * d_elevation + d_range * d_range
                near = density[k] * np.exp(-apart / 2)
                mass += near
                by_azimuth += near * d_azimuth
                by_elevation += near * d_elevation
                by_range += near * d_range
        found[0] += weight[n] * np.log(mass)
        if mass == floor:
            continue
        share = weight[n] / mass
        by_azimuth *= share * scale[0] / (level * level)
        by_elevation *= share * scale[1] / (level * far * far)
        by_range *= share * scale[2] / far
        gx = by_range * x - by_azimuth * y - by_elevation * z * x
        gy = by_range * y + by_azimuth * x - by_elevation * z * y
        gz = by_range * z + by_elevation * level * level
        found[1] += y * gz - z * gy
        found[2] += z * gx - x * gz
        found[3] += x * gy - y * gx
        found[4] += gx
        found[5] += gy
        found[6] += gz
    if total > 0.0:
        found /= total

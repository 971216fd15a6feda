"""Distribution of a day's static detections, and the resulting effect of elevation noise on roll, pitch and z."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.objective.radar.registration import RegistrationFrames
from pipeline.rig.spherical import to_spherical
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, Observation

__all__ = ["ElevationSpread", "beam_spacing", "elevation_spread"]

# How far elevations that are matched to the nearest lidar points bias roll, pitch [rad] and z [m]. Noise removes a part
# `noise^2 / spread^2` of every mismatch (regression dilution), and a mismatch is as large as the spread of the
# elevations: the angle noise^2 / spread. Real logs (3.2 deg of noise, spread 3.9): 2.6 deg where 1-2 deg of pitch and
# 4-5 deg of roll were seen; simulation (0.65 deg, spread 3-6): 0.07-0.16 deg where 0.01-0.12 was seen. A coarse lidar
# adds a share of its beam spacing, for points collapse onto the rings. z is wrong by the same angle at 15 m.
# Pitch alone errs by a fifth of the noise more: on 28 days of drawn worlds and rigs (seeds 6400 to 6435) .30 deg RMS,
# 1.7 of these floors without it (ceilings, crowns and what noise takes from one surface to the next), 1.1 with it.
# Roll errs by as much as the beams are apart. On the real car (beams 2 deg apart) the registration's roll repeats to .2
# deg over halves of the day and is -4.0 deg; boxes have -1.0 +- 1.1, the network +.2. Without it the floor is .8.
_RING_SHARE, _ROLL_RING_SHARE, _NOISE_SHARE = 0.05, 1.0, 0.2
_Z_DISTANCE_M, _Z_FLOOR_M = 15.0, 0.03
_ROLL_FACTOR = 0.7  # of pitch's at an azimuth of one radian: both sides seldom err in opposite directions
_DEFAULT_SPACING_RAD = np.radians(1.0)


@dataclass(frozen=True, eq=False)
class ElevationSpread:
    """Distribution of the static detections: standard deviation of elevations, RMS of azimuths [rad]."""

    elevation_rad: float
    azimuth_rad: float

    def floor(self, noise_rad: float, spacing_rad: float) -> np.ndarray:
        """Sigma of roll, pitch [rad] and z [m] of the registration due to this elevation noise."""
        angle = np.hypot(noise_rad**2 / self.elevation_rad, _RING_SHARE * spacing_rad)
        roll = np.hypot(self.roll_of_day(noise_rad), self._roll(_ROLL_RING_SHARE * spacing_rad))
        z_m = np.hypot(_Z_DISTANCE_M * angle, _Z_FLOOR_M)
        return np.array([roll, np.hypot(angle, _NOISE_SHARE * noise_rad), z_m])

    def roll_of_day(self, noise_rad: float) -> float:
        """Part of the roll's sigma that differs from day to day; points collapse onto the rings every day alike."""
        return self._roll(noise_rad**2 / self.elevation_rad)

    def _roll(self, angle_rad: float) -> float:
        return float(_ROLL_FACTOR * angle_rad / self.azimuth_rad)


def beam_spacing(observations: Sequence[Observation]) -> float:
    """Vertical spacing of the lidar's beams [rad], from its depth jumps between rings."""
    gaps = [
        o.lidar_edge_gap_rad[(o.lidar_edge_side == EDGE_ABOVE) | (o.lidar_edge_side == EDGE_BELOW)]
        for o in observations
    ]
    every = np.concatenate(gaps) if gaps else np.zeros(0)
    return float(np.median(every)) if len(every) else float(_DEFAULT_SPACING_RAD)


def elevation_spread(frames: RegistrationFrames) -> ElevationSpread:
    """Distribution of the static detections of these frames."""
    azimuth, elevation, _ = to_spherical(frames.radar_m).T
    # One degree: below it, noise alone would make as much.
    return ElevationSpread(
        max(float(np.std(elevation)), np.radians(1.0)),
        max(float(np.sqrt(np.mean(azimuth**2))), np.radians(3.0)),
    )

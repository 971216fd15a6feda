"""What comes by way of the road, in one echo with what comes directly: how strong both are, and where they point.

Object and mirror image in the road lie in one cell of range, and their amplitudes add up: each a sum of many
scatterers, so complex normal, and at 77 GHz the ways differ by many wavelengths. The estimator tells one elevation,
where both pull by their amplitudes: between the object and its image, by another share in every scan. Echoes that the
image strengthens are seen more often than those that it weakens, so detections lie too low in the mean.

Source: Barton 1974, "Low-angle radar tracking"; Howard 1959, "Radar target angular scintillation".
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.geometry.se3 import inverse, transform_points
from pipeline.geometry.spherical import from_spherical, to_spherical

__all__ = ["faded_by_road", "image_in_road"]

_REFLECTION = 0.9  # amplitude that asphalt leaves at grazing angles
_LEAST_HEIGHT_M = 0.15  # lower, a thing and its image are one


def faded_by_road(
    height_m: Float[np.ndarray, " N"], mirrored: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Power of every echo against its mean, and the share of the way to its mirror image at which it is seen.

    Args:
        height_m: over the road; what lies on it has no image.
        mirrored: share of the echoes with smooth road, which nothing stands on, where it would mirror them; it varies
            from scan to scan by half.
        rng: places and phases.
    """
    direct, image = (rng.standard_normal((2, len(height_m), 2)) @ [1.0, 1j]) / np.sqrt(2.0)
    smooth = rng.random(len(height_m)) < mirrored * rng.uniform(0.5, 1.5)
    image = _REFLECTION * image * (smooth & (height_m > _LEAST_HEIGHT_M))
    both = direct + image
    return np.abs(both) ** 2, np.clip(np.real(image / both), 0.0, 1.0)


def image_in_road(
    aer: Float[np.ndarray, "N 3"], T_vehicle_radar: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Height over the road [m] and the mirror image in it, of azimuth, elevation and range in the radar frame."""
    xyz_vehicle = transform_points(T_vehicle_radar, from_spherical(aer))
    image = xyz_vehicle * [1.0, 1.0, -1.0]
    return xyz_vehicle[:, 2], to_spherical(transform_points(inverse(T_vehicle_radar), image))

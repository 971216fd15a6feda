"""Multipath over the road, combined with the direct echo: power and apparent elevation.

Object and mirror image in the road share one range cell, and their amplitudes add: each is a sum of many
scatterers, hence complex normal, and at 77 GHz their paths differ by many wavelengths. The radar estimates
one elevation between the object and its image, weighted by amplitude, different in every scan. Echoes that
the image strengthens are detected more often than those it weakens, so the mean elevation is too low.

Source: Barton 1974, "Low-angle radar tracking"; Howard 1959, "Radar target angular scintillation".
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.rig.se3 import inverse, transform_points
from pipeline.rig.spherical import from_spherical, to_spherical

__all__ = ["faded_by_road", "image_in_road"]

_REFLECTION = 0.9  # amplitude reflected by asphalt at grazing angles
_LEAST_HEIGHT_M = 0.15  # below this height, an object and its image coincide


def faded_by_road(
    height_m: Float[np.ndarray, " N"], mirrored: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Power of every echo relative to its mean, and its position between object (0) and mirror image (1).

    Only objects above the road (`height_m`) have an image. `mirrored` is the share of echoes with smooth,
    empty road at the reflection point; it varies from scan to scan by half.
    """
    direct, image = (rng.standard_normal((2, len(height_m), 2)) @ [1.0, 1j]) / np.sqrt(2.0)
    smooth = rng.random(len(height_m)) < mirrored * rng.uniform(0.5, 1.5)
    image = _REFLECTION * image * (smooth & (height_m > _LEAST_HEIGHT_M))
    both = direct + image
    return np.abs(both) ** 2, np.clip(np.real(image / both), 0.0, 1.0)


def image_in_road(
    aer: Float[np.ndarray, "N 3"], T_vehicle_radar: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Height above the road [m], and mirror image as azimuth, elevation and range in the radar frame."""
    xyz_vehicle = transform_points(T_vehicle_radar, from_spherical(aer))
    image = xyz_vehicle * [1.0, 1.0, -1.0]
    return xyz_vehicle[:, 2], to_spherical(transform_points(inverse(T_vehicle_radar), image))

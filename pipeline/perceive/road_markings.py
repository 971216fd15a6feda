"""Road paint as lidar reflectivity and as image brightness: it determines pitch and roll of sparse lidars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8, UInt16
from numba import njit

from pipeline.perceive.ground import median_of

__all__ = ["Markings", "lidar_markings", "road_contrast"]

# Other points show the plain road; every fourth of them is enough for that.
_PLAIN_Z = 1.5
_PLAIN_STRIDE = 4
_MIN_BAND_POINTS = 20
_MAX_RANGE_M = 60.0  # beyond, one label pixel covers metres of road
# Lane paint is up to about 1/70 of the image wide where lidars first meet the road; the opening must be
# wider than paint.
_PAINT_FRACTION = 1 / 40


@dataclass(frozen=True, eq=False)
class Markings:
    """Ground points with their reflectivity in robust standard deviations; the columns `marking_*` of observations."""

    xyz_m: Float32[np.ndarray, "M 3"]
    z: Float32[np.ndarray, " M"]


def lidar_markings(
    xyz_m: Float32[np.ndarray, "N 3"],
    intensity: Float32[np.ndarray, " N"] | None,
    ring: UInt16[np.ndarray, " N"] | None,
    is_ground: Bool[np.ndarray, " N"],
) -> Markings:
    """Ground points and the contrast of their reflectivity to the road at the same ring or range.

    Reflectivity falls with range and incidence and differs from beam to beam, so it is compared only within a
    band: a ring, or 15 % of range if rings are not logged (rings near the horizon are split by range too).
    Empty without intensity.
    """
    range_m = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    if intensity is None or not is_ground.any():
        return Markings(np.empty((0, 3), np.float32), np.empty(0, np.float32))
    keep = np.flatnonzero(is_ground & (range_m > 1.0) & (range_m < _MAX_RANGE_M) & np.isfinite(intensity))
    band = np.floor(np.log(range_m[keep]) / np.log(1.15)).astype(np.int64)
    if ring is not None:
        band += 1000 * (1 + ring[keep].astype(np.int64))
    z = _robust_z(intensity[keep].astype(np.float64), band)
    known = np.isfinite(z)
    keep, z = keep[known], z[known]
    plain = z < _PLAIN_Z
    chosen = ~plain | (np.cumsum(plain) % _PLAIN_STRIDE == 0)
    return Markings(xyz_m[keep[chosen]].astype(np.float32), z[chosen].astype(np.float32))


def _robust_z(value: Float[np.ndarray, " M"], band: Int[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """(value - median)/robust sd within each band; NaN in bands too small to have either."""
    # 1.4826 MAD = sd of a normal law; at least one count, as logged intensities are small integers.
    one_count = 1.0 if value.max(initial=0.0) > 1.5 else 1 / 255
    order = np.argsort(band)
    start = np.flatnonzero(np.diff(band[order], prepend=band.min(initial=0) - 1))
    return _z_within(value, order, np.append(start, len(order)), one_count)


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _z_within(value: np.ndarray, order: np.ndarray, start: np.ndarray, least_spread: float) -> np.ndarray:
    z, held = np.full(len(value), np.nan), np.empty(len(value))
    for b in range(len(start) - 1):
        rows = order[start[b] : start[b + 1]]
        if len(rows) < _MIN_BAND_POINTS:
            continue
        for i in range(len(rows)):
            held[i] = value[rows[i]]
        middle = median_of(held, len(rows))
        for i in range(len(rows)):
            held[i] = abs(value[rows[i]] - middle)
        spread = max(1.4826 * median_of(held, len(rows)), least_spread)
        for i in rows:
            z[i] = (value[i] - middle) / spread
    return z


def road_contrast(
    grey: UInt8[np.ndarray, "H W"], road_mask: Bool[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W"]:
    """Top-hat contrast inside the road mask, 0 outside: brightness above the road to both sides.

    `grey` is the image at the size of the label image.
    """
    width = max(9, round(grey.shape[1] * _PAINT_FRACTION) | 1)
    # Along rows only: paint is narrow across the road, and the row is where the road's own brightness
    # is constant.
    top_hat = cv2.morphologyEx(grey, cv2.MORPH_TOPHAT, np.ones((1, width), np.uint8))
    # The mask's border has the contrast of kerb and cars, not of paint.
    inside = cv2.erode(road_mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return np.multiply(top_hat, inside, dtype=np.uint8)

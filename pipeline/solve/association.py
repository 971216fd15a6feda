"""Which track of one sensor is which track of another: by how they move first, by where they are last.

Range and range rate over ground do not depend on how a sensor is turned; nor does the course of the bearing, up to a
constant. The constant itself, the mean difference of the bearings, may be as large as the prior is uncertain. All are
compared over the frames that both tracks share, and tracks are paired one to one.

Source: Persic et al. 2021, "calibration-agnostic track to track association"; the measure is our reading of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.optimize import linear_sum_assignment

from pipeline.geometry.se3 import inverse, transform_points
from pipeline.geometry.spherical import to_spherical, wrap_angle
from pipeline.solve.tracks import Track

__all__ = ["Association", "associate", "bearing_sigma_rad", "shared_rows"]

_LEAST_SHARED = 2
_MOST_COUNTED = 8  # sightings of one track err together: a longer one is not ever more certain
_GATE = 6.0  # mean squared deviation in sigmas over up to four quantities
_MOST_SQUARE = 16.0  # of one quantity in one sighting: a filter's first velocities may be far off
_CONSTANT_SIGMAS = 3.0
_CENTRE_SIGMA_M, _ANGLE_SIGMA_RAD = 0.5, np.radians(0.5)  # the sensors mean different points of one object
_RANGE_OFFSET_SIGMA_M = 1.0  # near side against centre


@dataclass(frozen=True, eq=False)
class Association:
    """Pairs of tracks (rows of the reference's and of the other sensor's) and how well each pair agrees."""

    reference: Int64[np.ndarray, " K"]
    other: Int64[np.ndarray, " K"]
    score: Float[np.ndarray, " K"]  # larger is better, positive

    @property
    def count(self) -> int:
        """Number of pairs."""
        return len(self.reference)


def associate(
    reference: Sequence[Track],
    other: Sequence[Track],
    T_other_reference: Float[np.ndarray, "4 4"],
    rotation_sigma_rad: float,
    *,
    elevation: bool = True,
) -> Association:
    """Pair tracks one to one so that the sum of scores is largest; pairs outside the gates are not made.

    Args:
        reference: tracks of the reference sensor, level axes.
        other: tracks of the other sensor, its level axes.
        T_other_reference: transform between the level axes, as believed.
        rotation_sigma_rad: how uncertain its rotation is per axis.
        elevation: False where one of the two measures none.
    """
    score = np.zeros((len(reference), len(other)))
    last = [(t.frame[0], t.frame[-1]) for t in other]
    for i, a in enumerate(reference):
        for j, b in enumerate(other):
            if a.drive == b.drive and a.frame[-1] > last[j][0] and a.frame[0] < last[j][1]:
                score[i, j] = _score(a, b, T_other_reference, rotation_sigma_rad, elevation=elevation)
    rows, columns = linear_sum_assignment(score, maximize=True)
    kept = score[rows, columns] > 0
    return Association(
        rows[kept].astype(np.int64), columns[kept].astype(np.int64), score[rows, columns][kept]
    )


def shared_rows(a: Track, b: Track) -> tuple[Int64[np.ndarray, " S"], Int64[np.ndarray, " S"]]:
    """Sightings of two tracks in the same frames."""
    _, rows_a, rows_b = np.intersect1d(a.frame, b.frame, assume_unique=True, return_indices=True)
    return rows_a.astype(np.int64), rows_b.astype(np.int64)


def bearing_sigma_rad(range_m: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """How far apart two sensors' bearings of one object may lie: half a metre on it, and half a degree."""
    return np.hypot(_ANGLE_SIGMA_RAD, _CENTRE_SIGMA_M / np.maximum(range_m, 1.0))


def _score(a: Track, b: Track, T_b_a: np.ndarray, rotation_sigma_rad: float, *, elevation: bool) -> float:
    """Evidence that both are one object: (gate - mean squared deviation) per shared sighting; 0 outside the gates."""
    rows_a, rows_b = shared_rows(a, b)
    if len(rows_a) < _LEAST_SHARED:
        return 0.0
    expected = to_spherical(transform_points(T_b_a, a.position_m[rows_a]))
    seen = to_spherical(b.position_m[rows_b])
    # Ranges about the other sensor's origin and range rates along its line of sight: no rotation enters.
    from_origin = a.position_m[rows_a] - inverse(T_b_a)[:3, 3]
    rate_a = _along(a.velocity_mps[rows_a], from_origin)
    rate_b = _along(b.velocity_mps[rows_b], b.position_m[rows_b])
    range_var = a.range_sigma_m[rows_a] ** 2 + b.range_sigma_m[rows_b] ** 2 + _RANGE_OFFSET_SIGMA_M**2
    rate_var = a.rate_sigma_mps[rows_a] ** 2 + b.rate_sigma_mps[rows_b] ** 2
    sigma = bearing_sigma_rad(seen[:, 2])
    axes = (0, 1) if elevation else (0,)
    gap = wrap_angle(seen[:, axes] - expected[:, axes])
    constant = np.median(gap, axis=0)
    squares = np.column_stack(
        [
            (seen[:, 2] - expected[:, 2]) ** 2 / range_var,
            (rate_b - rate_a) ** 2 / rate_var,
            ((gap - constant) / sigma[:, None]) ** 2,
        ]
    )
    deviation = np.minimum(squares, _MOST_SQUARE).sum(axis=1)
    constant_square = float(np.sum(constant**2)) / (rotation_sigma_rad**2 + float(np.median(sigma)) ** 2)
    mean = float(np.mean(deviation))
    if mean > _GATE or constant_square > _CONSTANT_SIGMAS**2 * len(axes):
        return 0.0
    return max(min(len(rows_a), _MOST_COUNTED) * (_GATE - mean) - constant_square, 0.0)


def _along(velocity: np.ndarray, sight: np.ndarray) -> np.ndarray:
    return np.sum(velocity * sight, axis=1) / np.maximum(np.linalg.norm(sight, axis=1), 1e-6)

"""Unit of points, if it is not metres: tested by the distances of the points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["unit_that_fits"]

_IN_METRES = {"millimetres": 1e-3, "centimetres": 1e-2}
# Distance of the nearest tenth of a car's points: the road around the car, or what a radar detects on an
# empty one. It separates the units; nine tenths of the points must also be within the sensor's reach.
_NEAREST_M, _MOST = (1.0, 60.0), 0.9


def unit_that_fits(distance: Float[np.ndarray, " N"], reach_m: float) -> str:
    """Unit at which distances are plausible (at most `reach_m`); empty for metres or no match."""
    distance = distance[np.isfinite(distance) & (distance > 0)]
    if not len(distance):
        return ""
    nearest, farthest = np.quantile(distance, [0.1, _MOST])
    if nearest >= _NEAREST_M[0] / 10 and farthest <= reach_m:
        return ""
    typical = float(np.sqrt(np.prod(_NEAREST_M)))
    unit = min(_IN_METRES, key=lambda name: abs(np.log(max(nearest, 1e-9) * _IN_METRES[name] / typical)))
    metres = _IN_METRES[unit]
    is_near = _NEAREST_M[0] <= nearest * metres <= _NEAREST_M[1]
    return unit if is_near and farthest * metres <= reach_m else ""

"""Selection of rays that may hit a moving body, so that only those are cast; compiled."""
# numba infers the types of the arguments; `no_type_check` keeps the tests' shape checks out of compiled code.
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

__all__ = ["rays_near"]

_jit = numba.njit(cache=True)


@no_type_check
@_jit
def rays_near(origins, directions, delay, centre, velocity, radius, limit):
    """Indices of the rays (unit vectors) that pass within `radius` of a moving point, before their `limit`.

    `delay` is the time of each ray after that of `centre` [s].
    """
    out = np.empty(len(directions), np.int64)
    n = 0
    for i in range(len(directions)):
        x = centre[0] + velocity[0] * delay[i] - origins[i, 0]
        y = centre[1] + velocity[1] * delay[i] - origins[i, 1]
        z = centre[2] + velocity[2] * delay[i] - origins[i, 2]
        along = x * directions[i, 0] + y * directions[i, 1] + z * directions[i, 2]
        if (
            along > -radius
            and x * x + y * y + z * z - along * along < radius * radius
            and along - radius < limit[i]
        ):
            out[n] = i
            n += 1
    return out[:n]

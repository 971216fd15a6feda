"""Visible triangle per pixel, from half size to full size, and boxes of visible objects; compiled."""
# numba infers the types of the arguments; `no_type_check` keeps the tests' shape checks out of compiled code.
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

__all__ = ["extents", "upsampled"]

_jit = numba.njit(cache=True)


@no_type_check
@_jit
def upsampled(coarse, surface, height, width):
    """Triangles at full size, and flat indices of pixels with several surfaces in their neighbourhood."""
    h, w = coarse.shape
    out = np.empty((height, width), np.int32)
    unsure = np.empty(height * width, np.int64)
    n = 0
    for v in range(height):
        i = min(v // 2, h - 1)
        i2 = min(max(i + (1 if v % 2 else -1), 0), h - 1)
        for u in range(width):
            j = min(u // 2, w - 1)
            j2 = min(max(j + (1 if u % 2 else -1), 0), w - 1)
            out[v, u] = coarse[i, j]
            a = surface[coarse[i, j]]
            if a != surface[coarse[i2, j]] or a != surface[coarse[i, j2]] or a != surface[coarse[i2, j2]]:
                unsure[n] = v * width + u
                n += 1
    return out, unsure[:n]


@no_type_check
@_jit
def extents(coarse, group, groups):
    """(x0, y0, x1, y1, pixels) of each group of triangles."""
    out = np.empty((groups, 5), np.int64)
    out[:, :2], out[:, 2:] = 1 << 30, -1
    out[:, 4] = 0
    h, w = coarse.shape
    for i in range(h):
        for j in range(w):
            k = coarse[i, j]
            if k >= 0 and group[k] >= 0:
                o = out[group[k]]
                o[0], o[1], o[2], o[3] = min(o[0], j), min(o[1], i), max(o[2], j), max(o[3], i)
                o[4] += 1
    return out

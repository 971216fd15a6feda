"""Textures of surfaces: asphalt, grass, leaves, house fronts, paving, boards, worn paint; compiled."""
# numba infers the types of the arguments; `no_type_check` keeps the tests' shape checks out of compiled code.
# ruff: noqa: ANN001, ANN202, ANN201, C901, PLR0911
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

__all__ = ["texture", "textures", "value_noise"]

_jit = numba.njit(cache=True)
_fast = numba.njit(cache=True, fastmath=True)


@no_type_check
@_fast
def _lattice(ix, iy):
    """Reproducible number in [0, 1) for an integer lattice point (integer hash after Wang 2007)."""
    h = (ix * 374761393 + iy * 668265263) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFF) / 65536.0


@no_type_check
@_fast
def value_noise(x, y):
    """Smooth noise in [0, 1) with features of size 1."""
    fx, fy = np.floor(x), np.floor(y)
    ix, iy = int(fx), int(fy)
    a, b = x - fx, y - fy
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    top = _lattice(ix, iy) * (1 - a) + _lattice(ix + 1, iy) * a
    low = _lattice(ix, iy + 1) * (1 - a) + _lattice(ix + 1, iy + 1) * a
    return top * (1 - b) + low * b


@no_type_check
@_jit
def texture(kind, u, v):
    """(gain of the albedo, share of glass) of a texture at surface coordinates u, v [m]."""
    if kind == 1:  # asphalt: aggregate, wear, stains
        wear = value_noise(u * 0.13 + 7.0, v * 0.9)
        return 0.72 + 0.22 * wear + 0.22 * value_noise(u * 0.6, v * 0.6) + 0.16 * value_noise(
            u * 9.0, v * 9.0
        ), 0.0
    if kind == 2:  # grass
        return 0.55 + 0.5 * value_noise(u * 0.5, v * 0.5) + 0.5 * value_noise(u * 5.0, v * 5.0), 0.0
    if kind == 3:  # foliage: dark gaps between leaves
        n = 0.6 * value_noise(u * 3.0, v * 3.0) + 0.4 * value_noise(u * 9.0, v * 9.0)
        return 0.25 + 1.5 * n, 0.0
    if kind == 4:  # facade: bays of 2.7 m, storeys of 3 m
        bay, storey = u / 2.7 - np.floor(u / 2.7), v / 3.0 - np.floor(v / 3.0)
        if 0.27 < bay < 0.73 and 0.30 < storey < 0.80:
            frame = bay < 0.31 or bay > 0.69 or storey < 0.33 or storey > 0.77 or 0.49 < bay < 0.51
            return (1.5, 0.0) if frame else (0.16, 0.55)
        ledge = 0.82 if storey > 0.96 else 1.0
        return ledge * (
            0.86 + 0.2 * value_noise(u * 0.7, v * 0.7) + 0.08 * value_noise(u * 8.0, v * 8.0)
        ), 0.0
    if kind == 5:  # paving stones of 40 cm
        a, b = u / 0.4 - np.floor(u / 0.4), v / 0.4 - np.floor(v / 0.4)
        stone = 0.86 + 0.24 * _lattice(int(np.floor(u / 0.4)), int(np.floor(v / 0.4)))
        return (0.65 if a < 0.05 or b < 0.05 else stone), 0.0
    if kind == 6:  # boards of 16 cm
        a = u / 0.16 - np.floor(u / 0.16)
        return (0.45 if a < 0.12 else 0.8 + 0.3 * _lattice(int(np.floor(u / 0.16)), 3)), 0.0
    if kind == 7:
        return 0.85 + 0.2 * value_noise(u * 1.3, v * 1.3) + 0.1 * value_noise(u * 7.0, v * 7.0), 0.0
    if kind == 8:  # road paint: worn, tyre marks
        return 0.62 + 0.45 * value_noise(u * 1.1, v * 2.3) - 0.25 * (
            value_noise(u * 6.0, v * 6.0) > 0.78
        ), 0.0
    if kind == 9:  # cobbles of 12 cm, every other row shifted by half a stone
        row = np.floor(v / 0.12)
        x = u / 0.12 + 0.5 * (int(row) % 2)
        a, b = x - np.floor(x), v / 0.12 - row
        return (0.5 if a < 0.1 or b < 0.1 else 0.7 + 0.6 * _lattice(int(np.floor(x)), int(row))), 0.0
    if kind == 10:  # wire with a mesh of 6 cm, dark between the wires
        return (
            1.6 if u / 0.06 - np.floor(u / 0.06) < 0.2 or v / 0.06 - np.floor(v / 0.06) < 0.2 else 0.6
        ), 0.0
    return 1.0, 0.0


@no_type_check
@_jit
def textures(kinds, uv):
    """`texture` of many surface points."""
    gain, glass = np.empty(len(kinds)), np.empty(len(kinds))
    for i in range(len(kinds)):
        gain[i], glass[i] = texture(kinds[i], uv[i, 0], uv[i, 1])
    return gain, glass

"""Candidate lidar points of a radar detection: in the radar's view, sorted into cells, with elevations.

A frame has some hundred detections and thousands of lidar points, most of them near none. Computations on
every point (azimuth, range, cell of a coarse grid) therefore have no branches or library calls, and become
vector instructions. Points in cells near a detection are sorted by cell; only these get an elevation.
"""
# numba infers the types of the arguments; annotations would only repeat RegistrationFrames.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

__all__ = [
    "CUT", "cells_of", "distances_of_neighbours", "elevations", "seen_by_radar", "sort_reached", "spherical",
]  # fmt: skip

CUT = 9.0  # squared distance in (azimuth, range) beyond which a lidar point is no neighbour
_REACH = 3.0  # its root
_CELL = 1.5  # cell size in sigmas ...
# ... and at least so large that a table of cells costs less than the points: 70,000 cells of a sharp radar's sigmas
# cost four times as much as the 5,000 points of a frame.
_MOST_CELLS = (128, 64)  # by azimuth, by range
_SIDE_RAD = 1.6  # no radar on a car looks further to the side
_NO_BOUNCE_RAD = 10.0  # an elevation that no detection has
_BEHIND_RAD = 10.0  # added to azimuths of what lies behind the radar
_LEAST_HEIGHT_M = 0.3  # a lower point is as good as its own mirror image
# atan(s) / s as a polynomial of s^2 up to tan(1.7 / 4): to 1e-12, by interpolation at Chebyshev's points.
_ATAN = tuple(
    float(c)
    for c in np.polynomial.Chebyshev.interpolate(
        lambda q: np.arctan(np.sqrt(q)) / np.sqrt(q), 9, domain=(0.0, 0.206)
    )
    .convert(kind=np.polynomial.Polynomial)
    .coef
)

_called = numba.njit(cache=True, forceinline=True, fastmath=True, nogil=True, error_model="numpy")
_inline = numba.njit(fastmath=True, nogil=True, error_model="numpy", inline="always")


@no_type_check  # keeps the tests' shape checks out of compiled code
@_inline
def _angle(y, x, length):
    """atan2(y, x) to 1e-11 rad where it is within 1.7 rad; `length` is that of (x, y). Two halvings, a polynomial."""
    s = y / (length + x)
    s = s / (1.0 + np.sqrt(1.0 + s * s))
    q = s * s
    p = _ATAN[8] + q * _ATAN[9]
    p = _ATAN[6] + q * (_ATAN[7] + q * p)
    p = _ATAN[4] + q * (_ATAN[5] + q * p)
    p = _ATAN[2] + q * (_ATAN[3] + q * p)
    p = _ATAN[0] + q * (_ATAN[1] + q * p)
    return 4.0 * s * p


@no_type_check
@_called
def seen_by_radar(xyz, R, t, motion, range_bias, inverse_cell, cells, seen, cell):
    """Azimuth, range and Cartesian radar coordinates (rows of `seen`) of lidar points, and the cell of each.

    A point behind the radar, or too far away, is in the cell after the last.
    """
    # A loop each: LLVM checks at run time that arrays do not overlap, and for eight pairs at most.
    n = xyz.shape[0]
    azimuth, distance, ahead, left, up = seen[0, :n], seen[1, :n], seen[2, :n], seen[3, :n], seen[4, :n]
    turn = motion[3]
    # Seen tau later: the car has turned by w tau and moved by v tau.
    _along(
        xyz, t, R[0, 0] + turn * R[0, 1], R[1, 0] + turn * R[1, 1], R[2, 0] + turn * R[2, 1], motion[0], ahead
    )
    _along(
        xyz, t, R[0, 1] - turn * R[0, 0], R[1, 1] - turn * R[1, 0], R[2, 1] - turn * R[2, 0], motion[1], left
    )
    _along(xyz, t, R[0, 2], R[1, 2], R[2, 2], motion[2], up)
    for k in range(n):
        x, y = ahead[k], left[k]
        h = np.sqrt(x * x + y * y) + 1e-9
        is_ahead = x > -0.1 * h
        azimuth[k] = _angle(y, x if is_ahead else h, h) + (0.0 if is_ahead else _BEHIND_RAD)
    for k in range(n):
        x, y, z = ahead[k], left[k], up[k]
        distance[k] = np.sqrt(x * x + y * y + z * z) + range_bias
    most_a, most_r = float(cells[0]), float(cells[1])
    n_r, none = cells[1], cells[0] * cells[1]
    per_rad, per_m = inverse_cell
    for k in range(n):
        i, j = (azimuth[k] + _SIDE_RAD) * per_rad, distance[k] * per_m
        is_in = (i >= 0.0) & (j >= 0.0) & (i < most_a) & (j < most_r)
        cell[k] = np.int32(i if is_in else 0.0) * n_r + np.int32(j if is_in else 0.0) if is_in else none


@no_type_check
@_called
def _along(xyz, t, a, b, c, shift, out):
    """Coordinate of points about t along an axis, less a shift."""
    shift += t[0] * a + t[1] * b + t[2] * c
    for k in range(out.shape[0]):
        out[k] = xyz[k, 0] * a + xyz[k, 1] * b + xyz[k, 2] * c - shift


@no_type_check
@_called
def _reach(a, r, sigma, inverse_cell, cells):
    """First and last cell by azimuth, and by range, in which a detection may have neighbours."""
    i0 = int(max((a + _SIDE_RAD - _REACH * sigma[0]) * inverse_cell[0], 0.0))
    i1 = int(min((a + _SIDE_RAD + _REACH * sigma[0]) * inverse_cell[0], cells[0] - 1.0))
    j0 = int(max((r - _REACH * sigma[2]) * inverse_cell[1], 0.0))
    j1 = int(min((r + _REACH * sigma[2]) * inverse_cell[1], cells[1] - 1.0))
    return i0, i1, j0, j1


@no_type_check
@_called
def sort_reached(detections, sigma, inverse_cell, cells, cell, is_reached, start, in_reach, order):
    """Sort the points of the cells that detections (azimuth, elevation, range) reach; `start` is where cells begin.

    Returns their number; `in_reach` are the same, in the order of the points.
    """
    start[:] = 0
    is_reached[:] = 0
    for k in range(detections.shape[0]):
        i0, i1, j0, j1 = _reach(detections[k, 0], detections[k, 2], sigma, inverse_cell, cells)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                is_reached[i * cells[1] + j] = 1
    count = 0
    for k in range(cell.shape[0]):  # without a branch: most points are near no detection
        in_reach[count] = k
        count += is_reached[cell[k]]
    for k in in_reach[:count]:
        start[cell[k] + 2] += 1
    for c in range(start.shape[0] - 1):
        start[c + 1] += start[c]
    for k in in_reach[:count]:
        order[start[cell[k] + 1]] = k
        start[cell[k] + 1] += 1  # where the next cell begins, once all are placed
    return count


@no_type_check
@_called
def elevations(xyz, seen, order, plane, mirror, mirrors, near):
    """First rows of `near`, in this order: azimuth, range, elevation, that of the mirror image below the ground."""
    count = order.shape[0]
    azimuth, distance, elevation, bounced = near[0, :count], near[1, :count], near[2, :count], near[3, :count]
    x, y, z, height = near[4, :count], near[5, :count], near[6, :count], near[7, :count]
    for c in range(count):
        k = order[c]
        azimuth[c], distance[c] = seen[0, k], seen[1, k]
        x[c], y[c], z[c] = seen[2, k], seen[3, k], seen[4, k]
    _elevation(x, y, z, elevation)
    if not mirrors:
        bounced[:] = _NO_BOUNCE_RAD
        return
    for c in range(count):
        k = order[c]
        height[c] = plane[0] * xyz[k, 0] + plane[1] * xyz[k, 1] + plane[2] * xyz[k, 2] + plane[3]
    for c in range(count):
        x[c] -= height[c] * mirror[0]
        y[c] -= height[c] * mirror[1]
        z[c] -= height[c] * mirror[2]
    _elevation(x, y, z, bounced)
    for c in range(count):
        bounced[c] = bounced[c] if height[c] >= _LEAST_HEIGHT_M else _NO_BOUNCE_RAD


@no_type_check
@_called
def _elevation(x, y, z, out):
    """Elevation of points."""
    for c in range(out.shape[0]):
        h2 = x[c] * x[c] + y[c] * y[c]
        out[c] = _angle(z[c], np.sqrt(h2), np.sqrt(h2 + z[c] * z[c]) + 1e-9)


@no_type_check
@_called
def distances_of_neighbours(a, e, r, tells, sigma, inverse_cell, cells, start, near, found):
    """Distances in sigmas (azimuth, range, elevation, of the mirror image) of a detection's neighbours, as rows."""
    i0, i1, j0, j1 = _reach(a, r, sigma, inverse_cell, cells)
    per_a, per_e, per_r = 1 / sigma[0], 1 / sigma[1], 1 / sigma[2]
    if not tells:
        per_e = 0.0
    count = 0
    for i in range(i0, i1 + 1):
        for c in range(start[i * cells[1] + j0], start[i * cells[1] + j1 + 1]):
            da, dr = (near[0, c] - a) * per_a, (near[1, c] - r) * per_r
            found[0, count], found[1, count] = da, dr
            found[2, count], found[3, count] = (near[2, c] - e) * per_e, (near[3, c] - e) * per_e
            count += da * da + dr * dr <= CUT
    return count


@no_type_check
@_called
def spherical(R, t, radar, limits, has_elevation, sph, tells):
    """Azimuth, elevation and range of detections, and whether their elevation can be compared with the lidar's."""
    for k in range(radar.shape[0]):
        x, y, z = radar[k, 0], radar[k, 1], radar[k, 2]
        h = np.sqrt(x * x + y * y)
        r = np.sqrt(h * h + z * z)
        sph[k, 0] = _angle(y, x, h) if x > -0.1 * h else np.arctan2(y, x)
        sph[k, 1], sph[k, 2] = _angle(z, h, r + 1e-9), r
        up = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        flat = np.hypot(
            R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0], R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
        )
        tells[k] = has_elevation and limits[0] * flat < up and up < limits[1] * flat


@no_type_check
@_called
def cells_of(sigma, max_range):
    """Number of cells of the grid (in azimuth, in range), and number of cells per radian and per metre."""
    cell_a = max(_CELL * sigma[0], 2 * _SIDE_RAD / _MOST_CELLS[0])
    cell_r = max(_CELL * sigma[2], max_range / _MOST_CELLS[1])
    cells = (int(2 * _SIDE_RAD / cell_a) + 1, int(max_range / cell_r) + 1)
    return cells, (1 / cell_a, 1 / cell_r)

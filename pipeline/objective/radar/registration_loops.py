"""The loop behind `registration`: soft assignment of radar detections to lidar points, frame by frame.

A frame has some hundred detections and thousands of lidar points, most of them near none. So what is asked of every
point is free of branches and library calls, to become vector instructions: its azimuth and range, and its cell of a
coarse grid. Points in cells that some detection reaches are sorted by cell; only these get an elevation.
"""
# numba infers the types of the arguments; annotations would only repeat RegistrationFrames.
# ruff: noqa: ANN001, ANN202
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

__all__ = ["CUT", "STATS", "accumulate_frames"]

STATS = 12  # per frame: log likelihood, detections, assigned, bounced, sums of g r^2 (az, el, r), sums of g (3), spare
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

_jit = numba.njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
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
@_inline
def _exp(x):
    """exp(x) of x <= 0, to 1e-9 of it down to -10; below -40 that of -40. Taylor of x / 64, six squarings."""
    t = max(x, -40.0) * (1.0 / 64.0)
    p = 1.0 + t * (1.0 / 6.0) * (1.0 + t * (1.0 / 7.0))
    p = 1.0 + t * (1.0 / 4.0) * (1.0 + t * (1.0 / 5.0) * p)
    p = 1.0 + t * (1.0 + t * (1.0 / 2.0) * (1.0 + t * (1.0 / 3.0) * p))
    p *= p
    p *= p
    p *= p
    p *= p
    p *= p
    return p * p


@no_type_check
@_jit
def _seen_by_radar(xyz, R, t, motion, range_bias, inverse_cell, cells, seen, cell):
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
@_jit
def _along(xyz, t, a, b, c, shift, out):
    """Coordinate of points about t along an axis, less a shift."""
    shift += t[0] * a + t[1] * b + t[2] * c
    for k in range(out.shape[0]):
        out[k] = xyz[k, 0] * a + xyz[k, 1] * b + xyz[k, 2] * c - shift


@no_type_check
@_jit
def _reach(a, r, sigma, inverse_cell, cells):
    """First and last cell by azimuth, and by range, in which a detection may have neighbours."""
    i0 = int(max((a + _SIDE_RAD - _REACH * sigma[0]) * inverse_cell[0], 0.0))
    i1 = int(min((a + _SIDE_RAD + _REACH * sigma[0]) * inverse_cell[0], cells[0] - 1.0))
    j0 = int(max((r - _REACH * sigma[2]) * inverse_cell[1], 0.0))
    j1 = int(min((r + _REACH * sigma[2]) * inverse_cell[1], cells[1] - 1.0))
    return i0, i1, j0, j1


@no_type_check
@_jit
def _sort_reached(detections, sigma, inverse_cell, cells, cell, is_reached, start, order):
    """Sort the points of the cells that detections (azimuth, elevation, range) reach; `start` is where cells begin."""
    start[:] = 0
    is_reached[:] = 0
    for k in range(detections.shape[0]):
        i0, i1, j0, j1 = _reach(detections[k, 0], detections[k, 2], sigma, inverse_cell, cells)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                is_reached[i * cells[1] + j] = 1
    for k in range(cell.shape[0]):
        start[cell[k] + 1] += is_reached[cell[k]]
    for c in range(start.shape[0] - 1):
        start[c + 1] += start[c]
    count = start[start.shape[0] - 1]
    for k in range(cell.shape[0]):
        c = cell[k]
        if is_reached[c]:
            order[start[c]] = k
            start[c] += 1
    for c in range(start.shape[0] - 1, 0, -1):
        start[c] = start[c - 1]
    start[0] = 0
    return count


@no_type_check
@_jit
def _elevations(xyz, seen, order, plane, mirror, mirrors, near):
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
@_jit
def _elevation(x, y, z, out):
    """Elevation of points."""
    for c in range(out.shape[0]):
        h2 = x[c] * x[c] + y[c] * y[c]
        out[c] = _angle(z[c], np.sqrt(h2), np.sqrt(h2 + z[c] * z[c]) + 1e-9)


@no_type_check
@_jit
def _neighbours(a, e, r, tells, sigma, inverse_cell, cells, start, near, found):
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
@_jit
def _likelihood(count, found, direct_prior, bounce_prior):
    """Sum of the neighbours' weights."""
    total = 0.0
    if bounce_prior > 0:
        for n in range(count):
            da, dr, de, db = found[0, n], found[1, n], found[2, n], found[3, n]
            d2 = da * da + dr * dr
            total += direct_prior * _exp(-0.5 * (d2 + de * de)) + bounce_prior * _exp(-0.5 * (d2 + db * db))
        return total
    for n in range(count):
        da, dr, de = found[0, n], found[1, n], found[2, n]
        total += _exp(-0.5 * (da * da + dr * dr + de * de))
    return direct_prior * total


@no_type_check
@_jit
def _moments(count, found, direct_prior, bounce_prior, sums):
    """Sums of the neighbours' weights (direct, all), and of weight times distance and squared distance."""
    direct, total, m0, m1, m2, q0, q1, q2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(count):
        da, dr, de, db = found[0, n], found[1, n], found[2, n], found[3, n]
        d2 = da * da + dr * dr
        wd = direct_prior * _exp(-0.5 * (d2 + de * de))
        w = wd + bounce_prior * _exp(-0.5 * (d2 + db * db))
        direct += wd
        total += w
        m0 += w * da
        m1 += wd * de
        m2 += w * dr
        q0 += w * da * da
        q1 += wd * de * de
        q2 += w * dr * dr
    sums[0], sums[1] = direct, total
    sums[2], sums[3], sums[4] = m0, m1, m2
    sums[5], sums[6], sums[7] = q0, q1, q2


@no_type_check
@_jit
def _jacobian(J, x, y, z, R, t, v, w, tau):
    """d(azimuth, elevation, range of a static lidar point)/d(left twist of T_lidar_radar, tau, range bias).

    The lidar point is the one that appears at (x, y, z): q' = q - (v + w x q) tau with q = T_radar_lidar p.
    """
    turn = w * tau
    qx, qy, qz = x + v[0] * tau, y + v[1] * tau, z + v[2] * tau
    qx, qy = qx - turn * qy, qy + turn * qx
    px = R[0, 0] * qx + R[0, 1] * qy + R[0, 2] * qz + t[0]
    py = R[1, 0] * qx + R[1, 1] * qy + R[1, 2] * qz + t[1]
    pz = R[2, 0] * qx + R[2, 1] * qy + R[2, 2] * qz + t[2]
    h2 = x * x + y * y
    h = np.sqrt(h2)
    r2 = h2 + z * z
    r = np.sqrt(r2)
    for row in range(3):
        if row == 0:
            s0, s1, s2 = -y / h2, x / h2, 0.0
        elif row == 1:
            s0, s1, s2 = -x * z / (h * r2), -y * z / (h * r2), h / r2
        else:
            s0, s1, s2 = x / r, y / r, z / r
        J[row, 6] = -(s0 * (v[0] - w * qy) + s1 * (v[1] + w * qx) + s2 * v[2])
        s0, s1 = s0 - turn * s1, s1 + turn * s0
        # u = R s: gradient in lidar axes; dq = R^T ([p]x dphi - drho), u . ([p]x w) = (u x p) . w
        u0 = R[0, 0] * s0 + R[0, 1] * s1 + R[0, 2] * s2
        u1 = R[1, 0] * s0 + R[1, 1] * s1 + R[1, 2] * s2
        u2 = R[2, 0] * s0 + R[2, 1] * s1 + R[2, 2] * s2
        J[row, 0] = u1 * pz - u2 * py
        J[row, 1] = u2 * px - u0 * pz
        J[row, 2] = u0 * py - u1 * px
        J[row, 3], J[row, 4], J[row, 5] = -u0, -u1, -u2
        J[row, 7] = 1.0 if row == 2 else 0.0


@no_type_check
@_jit
def _add_row(j, weight, mean, known, H, g, info):
    """Add one weighted residual, whose derivatives are j."""
    for p in range(8):
        g[p] += weight * mean * j[p]
        whole, sure = weight * j[p], known * j[p]
        for q in range(8):
            H[p, q] += whole * j[q]
            info[p, q] += sure * j[q]


@no_type_check
@_jit
def _linearise(sums, outlier, tells, J, sigma, H, g, info, stats):
    """Add a detection's rows (derivatives J) to its frame's equations, and what it shows of the radar's sigmas."""
    direct, total = sums[0], sums[1]
    gamma = total / (total + outlier)
    share = direct / total
    stats[2] += gamma
    stats[3] += gamma * (1 - share)
    for row in range(3):
        if row == 1 and not tells:
            continue
        over = max(direct, 1e-12) if row == 1 else total
        weight = gamma * share if row == 1 else gamma
        mean, square = sums[2 + row] / over, sums[5 + row] / over
        stats[4 + row] += weight * square
        if row == 1:
            stats[7] += weight
        known = weight * max(0.0, 1.0 - max(0.0, square - mean * mean))
        part = 1 if row == 1 else 0
        for p in range(8):
            J[row, p] /= sigma[row]
        _add_row(J[row], weight, mean, known, H[part], g[part], info[part])


@no_type_check
@_jit
def _spherical(R, t, radar, limits, has_elevation, sph, tells):
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
@_jit
def accumulate_frames(
    T, tau, range_bias, velocity, yaw_rate, radar, radar_first, lidar, lidar_first, plane, has_plane,
    use_elevation, limits, sigma,
    outlier, bounce_prior, stride, max_range, with_equations, H, g, info, stats,
) -> None:  # fmt: skip
    """Normal equations of each frame: H (F, 2, 8, 8) and g (F, 2, 8) for (azimuth and range, elevation), information.

    `info` is H less what the uncertain assignment takes away (Louis 1982), row by row. A detection whose elevation in
    lidar axes is not inside `limits` (tangents, low and high) is assigned by azimuth and range alone. Without
    `with_equations` only the first two of `stats` are filled: log likelihood and detections.
    """
    # One body for all frames: its buffers are made once.
    R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
    most, most_radar = 1, 1
    for f in range(len(radar_first) - 1):
        most = max(most, lidar_first[f + 1] - lidar_first[f])
        most_radar = max(most_radar, radar_first[f + 1] - radar_first[f])
    cell_a = max(_CELL * sigma[0], 2 * _SIDE_RAD / _MOST_CELLS[0])
    cell_r = max(_CELL * sigma[2], max_range / _MOST_CELLS[1])
    cells, inverse_cell = (
        (int(2 * _SIDE_RAD / cell_a) + 1, int(max_range / cell_r) + 1),
        (1 / cell_a, 1 / cell_r),
    )
    seen, near, found = np.empty((5, most)), np.empty((8, most)), np.empty((4, most + 1))
    order, cell = np.empty(most, np.int32), np.empty(most, np.int32)
    start = np.empty(cells[0] * cells[1] + 2, np.int32)
    is_reached = np.empty(cells[0] * cells[1] + 1, np.uint8)
    sph, tells = np.empty((most_radar, 3)), np.empty(most_radar, np.bool_)
    J, sums, motion, mirror = np.empty((3, 8)), np.empty(8), np.empty(4), np.empty(3)
    for f in range(len(radar_first) - 1):
        points = lidar[lidar_first[f] : lidar_first[f + 1]]
        detections = radar[radar_first[f] : radar_first[f + 1] : stride]
        n, m = points.shape[0], detections.shape[0]
        motion[:3] = velocity[f] * tau[f]
        motion[3] = yaw_rate[f] * tau[f]
        _spherical(R, t, detections, limits, use_elevation[f], sph, tells)
        _seen_by_radar(points, R, t, motion, range_bias, inverse_cell, cells, seen, cell)
        count = _sort_reached(sph[:m], sigma, inverse_cell, cells, cell[:n], is_reached, start, order)
        # A mirror image lies twice its height along the road's normal below; the turn while tau turns that too.
        for k in range(3):
            mirror[k] = 2 * (R[0, k] * plane[f, 0] + R[1, k] * plane[f, 1] + R[2, k] * plane[f, 2])
        mirror[0], mirror[1] = mirror[0] + motion[3] * mirror[1], mirror[1] - motion[3] * mirror[0]
        mirrors = has_plane[f] and bounce_prior > 0
        _elevations(points, seen, order[:count], plane[f], mirror, mirrors, near)
        for k in range(m):
            of_bounce = bounce_prior if tells[k] else 0.0
            reached = _neighbours(
                sph[k, 0], sph[k, 1], sph[k, 2], tells[k], sigma, inverse_cell, cells, start, near, found
            )
            stats[f, 1] += 1
            if not with_equations:
                stats[f, 0] += np.log(_likelihood(reached, found, 1 - bounce_prior, of_bounce) + outlier)
                continue
            _moments(reached, found, 1 - bounce_prior, of_bounce, sums)
            stats[f, 0] += np.log(sums[1] + outlier)
            if sums[1] < 1e-6:
                continue
            x, y, z = detections[k, 0], detections[k, 1], detections[k, 2]
            _jacobian(J, x, y, z, R, t, velocity[f], yaw_rate[f], tau[f])
            _linearise(sums, outlier, tells[k], J, sigma, H[f], g[f], info[f], stats[f])

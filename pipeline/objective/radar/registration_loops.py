"""The loop behind `registration`: soft assignment of radar detections to lidar points, frame by frame."""
# numba infers the types of the arguments; annotations would only repeat RegistrationFrames.
# ruff: noqa: ANN001, ANN202
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

from pipeline.objective.radar.registration_neighbours import (
    cells_of,
    distances_of_neighbours,
    elevations,
    seen_by_radar,
    sort_reached,
    spherical,
)

__all__ = ["STATS", "accumulate_frames"]

STATS = 12  # per frame: log likelihood, detections, assigned, bounced, sums of g r^2 (az, el, r), sums of g (3), spare

_jit = numba.njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
_called = numba.njit(cache=True, forceinline=True, fastmath=True, nogil=True, error_model="numpy")
_inline = numba.njit(fastmath=True, nogil=True, error_model="numpy", inline="always")


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
@_called
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
@_called
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
@_called
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
@_called
def _add_row(j, weight, mean, known, H, g, info):
    """Add one weighted residual, whose derivatives are j."""
    for p in range(8):
        g[p] += weight * mean * j[p]
        whole, sure = weight * j[p], known * j[p]
        for q in range(8):
            H[p, q] += whole * j[q]
            info[p, q] += sure * j[q]


@no_type_check
@_called
def _linearise(sums, outlier, tells, J, sigma, H, g, info, stats):
    """Add a detection's rows (derivatives J) to its frame's equations, and its squared residuals to the sigmas."""
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
def accumulate_frames(
    T, tau, range_bias, velocity, yaw_rate, radar, radar_first, lidar, lidar_first, plane, has_plane,
    use_elevation, limits, sigma,
    outlier, bounce_prior, stride, max_range, with_equations, H, g, info, stats,
) -> None:  # fmt: skip
    """Normal equations of each frame: H (F, 2, 8, 8) and g (F, 2, 8) for (azimuth and range, elevation), information.

    `info` is H minus the loss by uncertain assignment (Louis 1982), row by row. A detection whose elevation
    in lidar axes is not inside `limits` (tangents, low and high) is assigned by azimuth and range alone.
    Without `with_equations` only the first two of `stats` are filled: log likelihood and detections.
    """
    # One body for all frames: its buffers are made once.
    R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
    most, most_radar = 1, 1
    for f in range(len(radar_first) - 1):
        most = max(most, lidar_first[f + 1] - lidar_first[f])
        most_radar = max(most_radar, radar_first[f + 1] - radar_first[f])
    cells, inverse_cell = cells_of(sigma, max_range)
    seen, near, found = np.empty((5, most)), np.empty((8, most)), np.empty((4, most + 1))
    order, cell, in_reach = np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, np.int32)
    start = np.empty(cells[0] * cells[1] + 3, np.int32)
    is_reached = np.empty(cells[0] * cells[1] + 1, np.uint8)
    sph, tells = np.empty((most_radar, 3)), np.empty(most_radar, np.bool_)
    J, sums, motion, mirror = np.empty((3, 8)), np.empty(8), np.empty(4), np.empty(3)
    for f in range(len(radar_first) - 1):
        points = lidar[lidar_first[f] : lidar_first[f + 1]]
        detections = radar[radar_first[f] : radar_first[f + 1] : stride]
        n, m = points.shape[0], detections.shape[0]
        motion[:3] = velocity[f] * tau[f]
        motion[3] = yaw_rate[f] * tau[f]
        spherical(R, t, detections, limits, use_elevation[f], sph, tells)
        seen_by_radar(points, R, t, motion, range_bias, inverse_cell, cells, seen, cell)
        count = sort_reached(
            sph[:m], sigma, inverse_cell, cells, cell[:n], is_reached, start, in_reach, order
        )
        # A mirror image lies twice its height along the road's normal below; the turn while tau turns that too.
        for k in range(3):
            mirror[k] = 2 * (R[0, k] * plane[f, 0] + R[1, k] * plane[f, 1] + R[2, k] * plane[f, 2])
        mirror[0], mirror[1] = mirror[0] + motion[3] * mirror[1], mirror[1] - motion[3] * mirror[0]
        mirrors = has_plane[f] and bounce_prior > 0
        elevations(points, seen, order[:count], plane[f], mirror, mirrors, near)
        for k in range(m):
            of_bounce = bounce_prior if tells[k] else 0.0
            reached = distances_of_neighbours(
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

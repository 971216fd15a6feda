"""The compiled loops of the simulator: textures, shading, rays near a body, boxes of what is visible, peaks.

Scalar code for numba; arguments are those of the functions that call them.
"""
# numba infers the types of the arguments; `no_type_check` keeps the tests' shape checks out of compiled code.
# ruff: noqa: ANN001, ANN201, ANN202, C901, D103, PLR0911, PLR0915, PLR1714
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

__all__ = [
    "developed",
    "extents",
    "near",
    "shade",
    "texture",
    "textures",
    "unsuppressed",
    "upsampled",
    "value_noise",
]

_jit = numba.njit(cache=True)
_fast = numba.njit(cache=True, fastmath=True)


@no_type_check
@_fast
def _lattice(ix, iy):
    """Reproducible number in [0, 1) of an integer lattice point (integer hash after Wang 2007)."""
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
    return 1.0, 0.0


@no_type_check
@_jit
def textures(kinds, uv):
    """`texture` of many surface points."""
    gain, glass = np.empty(len(kinds)), np.empty(len(kinds))
    for i in range(len(kinds)):
        gain[i], glass[i] = texture(kinds[i], uv[i, 0], uv[i, 1])
    return gain, glass


@no_type_check
@_jit
def near(origins, directions, delay, centre, velocity, radius, limit):
    """Rays that pass within `radius` of a moving point, before what they have hit already."""
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


@no_type_check
@_jit
def upsampled(coarse, surface, height, width):
    """Triangles at full size, and flat indices of pixels where the half-size neighbourhood is not of one surface."""
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
@_fast
def _sky(x, y, z, sx, sy, sz):
    """Sky radiance (r, g, b) of a direction: gradient, clouds, glow around the sun."""
    up = max(z, 0.0)
    a = np.sqrt(up)
    r, g, b = 0.74 - 0.52 * a, 0.80 - 0.40 * a, 0.88 - 0.18 * a
    if up > 0.01:
        px, py = x / (up + 0.12) + 97.0 * sx, y / (up + 0.12)  # other clouds on every drive
        n = (
            0.55 * value_noise(px * 1.3 + 31, py * 1.3)
            + 0.3 * value_noise(px * 3.1, py * 3.1 + 9)
            + 0.15 * value_noise(px * 7.0, py * 7.0)
        )
        cloud = min(max((n - 0.5) * 4.0, 0.0), 1.0) * min(up * 8.0, 1.0)
        r, g, b = r + (0.92 - r) * cloud, g + (0.92 - g) * cloud, b + (0.93 - b) * cloud
    glow = max(x * sx + y * sy + z * sz, 0.0) ** 24
    return r + 0.5 * glow, g + 0.45 * glow, b + 0.35 * glow


@no_type_check
@_fast
def shade(
    seen,
    rays,
    origin,
    corners,
    normals,
    material,
    tint,
    uv,
    albedo,
    kind,
    glass,
    glow,
    label,
    sun,
    sun_light,
    sky_light,
    sky_gain,
    light,
    s0,
    d0,
    cell,
    blobs,
):
    """Linear RGB of each pixel."""
    height, width = seen.shape
    out = np.empty((height, width, 3), np.float32)
    for i in range(height):
        for j in range(width):
            dx, dy, dz = rays[i, j, 0], rays[i, j, 1], rays[i, j, 2]
            k = seen[i, j]
            if k < 0:
                r, g, b = _sky(dx, dy, dz, sun[0], sun[1], sun[2])
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = r * sky_gain, g * sky_gain, b * sky_gain
                continue
            # Ray and plane of the triangle, barycentric coordinates (Moller and Trumbore 1997).
            ax, ay, az = corners[k, 0, 0], corners[k, 0, 1], corners[k, 0, 2]
            e1x, e1y, e1z = corners[k, 1, 0] - ax, corners[k, 1, 1] - ay, corners[k, 1, 2] - az
            e2x, e2y, e2z = corners[k, 2, 0] - ax, corners[k, 2, 1] - ay, corners[k, 2, 2] - az
            px, py, pz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
            det = e1x * px + e1y * py + e1z * pz
            inv = 1.0 / det if abs(det) > 1e-12 else 0.0
            tx, ty, tz = origin[0] - ax, origin[1] - ay, origin[2] - az
            bu = (tx * px + ty * py + tz * pz) * inv
            qx, qy, qz = ty * e1z - tz * e1y, tz * e1x - tx * e1z, tx * e1y - ty * e1x
            bv = (dx * qx + dy * qy + dz * qz) * inv
            # At the horizon a neighbour's triangle can be edge on, and its plane lie behind: no haze there.
            t = max((e2x * qx + e2y * qy + e2z * qz) * inv, 0.0)
            bw = 1.0 - bu - bv
            su = bw * uv[k, 0, 0] + bu * uv[k, 1, 0] + bv * uv[k, 2, 0]
            sv = bw * uv[k, 0, 1] + bu * uv[k, 1, 1] + bv * uv[k, 2, 1]
            nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
            facing = nx * dx + ny * dy + nz * dz
            if facing > 0:
                nx, ny, nz, facing = -nx, -ny, -nz, -facing
            m = material[k]
            gain, pane = texture(kind[m], su, sv)
            # Texture finer than a pixel averages out: fade its contrast with distance.
            fade = min(1.0, 22.0 / max(t, 1.0)) if kind[m] != 4 else 1.0
            gain = 1.0 + (gain - 1.0) * fade
            mirror = max(glass[m], pane)
            lit = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 0.0)
            if kind[m] == 3:  # leaves face everywhere: a crown is lit more evenly than its outline
                lit = (0.25 + 0.45 * lit) * (0.5 + value_noise(su * 1.7, sv * 1.7))
            shade, ambient = 1.0, 0.55 + 0.45 * nz
            lab = label[m]
            if lab == 0 or lab == 1 or lab == 9:
                a, b2 = int((su - s0) / cell), int((sv - d0) / cell)
                if 0 <= a < light.shape[0] - 1 and 0 <= b2 < light.shape[1] - 1:
                    fa, fb = (su - s0) / cell - a, (sv - d0) / cell - b2
                    shade = (light[a, b2] * (1 - fa) + light[a + 1, b2] * fa) * (1 - fb) + (
                        light[a, b2 + 1] * (1 - fa) + light[a + 1, b2 + 1] * fa
                    ) * fb
                hx, hy, hz = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
                for q in range(len(blobs)):
                    ox, oy = hx - blobs[q, 0], hy - blobs[q, 1]
                    if ox * ox + oy * oy < 64.0 and abs(hz - blobs[q, 6]) < 1.0:
                        lx = abs(ox * blobs[q, 2] + oy * blobs[q, 3]) - blobs[q, 4]
                        ly = abs(-ox * blobs[q, 3] + oy * blobs[q, 2]) - blobs[q, 5]
                        ambient *= 1.0 - 0.75 * min(max(0.5 - 1.4 * max(lx, ly), 0.0), 1.0)
                        # the sun's shadow of a body about 1.5 m high
                        ex, ey = ox + 0.75 * sun[0] / sun[2], oy + 0.75 * sun[1] / sun[2]
                        lx = abs(ex * blobs[q, 2] + ey * blobs[q, 3]) - blobs[q, 4] - 0.2
                        ly = abs(-ex * blobs[q, 3] + ey * blobs[q, 2]) - blobs[q, 5] - 0.2
                        shade *= 1.0 - min(max(0.5 - 4.0 * max(lx, ly), 0.0), 1.0)
            e = sky_light * ambient + sun_light * lit * shade
            r = albedo[m, 0] * tint[k, 0] * gain * e
            g = albedo[m, 1] * tint[k, 1] * gain * e
            b = albedo[m, 2] * tint[k, 2] * gain * e * (1.0 + 0.1 * (1 - shade))
            if mirror > 0 or glow[m] > 0 or lab == 13:
                rx, ry, rz = dx - 2 * facing * nx, dy - 2 * facing * ny, dz - 2 * facing * nz
                fresnel = 0.06 + 0.94 * (1.0 + facing) ** 5
                strength = (0.25 + fresnel) * mirror if mirror > 0 else 0.35 * fresnel
                if rz > 0:
                    cr, cg, cb = _sky(rx, ry, rz, sun[0], sun[1], sun[2])
                    r, g, b = (
                        r + strength * 0.55 * cr * sky_gain,
                        g + strength * 0.55 * cg * sky_gain,
                        b + strength * 0.55 * cb * sky_gain,
                    )
                else:
                    r, g, b = (
                        r + strength * 0.10 * sky_gain,
                        g + strength * 0.10 * sky_gain,
                        b + strength * 0.10 * sky_gain,
                    )
                r, g, b = (
                    r + glow[m] * tint[k, 0] * albedo[m, 0],
                    g + glow[m] * tint[k, 1] * albedo[m, 1],
                    b + glow[m] * tint[k, 2] * albedo[m, 2],
                )
            haze = 1.0 - np.exp(-t / 900.0)
            out[i, j, 0] = r + (0.72 * sky_gain - r) * haze
            out[i, j, 1] = g + (0.78 * sky_gain - g) * haze
            out[i, j, 2] = b + (0.86 * sky_gain - b) * haze
    return out


@no_type_check
@_fast
def developed(linear, exposure, grain, noise, curve):
    h, w, _ = linear.shape
    out = np.empty((h, w, 3), np.uint8)
    for i in range(h):
        y = 2.0 * i / (h - 1) - 1.0
        for j in range(w):
            x = 2.0 * j / (w - 1) - 1.0
            gain = exposure * (1.0 - 0.22 * (x * x + 0.35 * y * y)) * 4096.0
            for c in range(3):
                value = curve[int(min(max(linear[i, j, c] * gain, 0.0), 4096.0))]
                # Shot noise is largest in the shadows after the gamma.
                value += grain[i, j, c] * noise * (1.35 - value / 255.0)
                out[i, j, 2 - c] = min(max(value, 0.0), 255.0)
    return out


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


@no_type_check
@_jit
def unsuppressed(x):
    keep = np.ones(len(x), np.bool_)
    for i in range(len(x)):
        if keep[i]:
            for j in range(i + 1, len(x)):
                if np.all(np.abs(x[i] - x[j]) < 1.0):
                    keep[j] = False
    return keep

"""Colour of each pixel: texture, sun, sky, shadows, mirrors, haze, and sensor response; compiled."""
# numba infers the types of the arguments; `no_type_check` keeps the tests' shape checks out of compiled code.
# ruff: noqa: ANN001, ANN201, ANN202, C901, PLR0915, PLR1714
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numba
import numpy as np

from pipeline.simulate.world.textures import texture, value_noise

__all__ = ["Light", "Sight", "Surfaces", "developed", "shade"]

_fast = numba.njit(cache=True, fastmath=True)


class Sight(NamedTuple):
    """Visible triangle per pixel H W (-1 = sky), direction H W 3 in the map, start of all rays [m]."""

    seen: np.ndarray
    rays: np.ndarray
    origin: np.ndarray


class Surfaces(NamedTuple):
    """Triangles: corners T 3 3 [m], unit normals T 3, material T, tint T 3, texture coordinates T 3 2 [m]."""

    corners: np.ndarray
    normals: np.ndarray
    material: np.ndarray
    tint: np.ndarray
    uv: np.ndarray


class Light(NamedTuple):
    """Direction to the sun in the map; irradiance from sun (facing it) and sky; brightness of the sky."""

    sun: np.ndarray
    sun_light: float
    sky_light: float
    sky_gain: float


@no_type_check
@_fast
def _sky(x, y, z, sx, sy, sz):
    """Sky radiance (r, g, b) of a direction: gradient, clouds, glow around the sun."""
    up = max(z, 0.0)
    a = np.sqrt(up)
    r, g, b = 0.74 - 0.52 * a, 0.80 - 0.40 * a, 0.88 - 0.18 * a
    if up > 0.01:
        px, py = x / (up + 0.12) + 97.0 * sx, y / (up + 0.12)  # other clouds in every drive
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
def shade(sight, surfaces, materials, light, shadows, blobs):
    """Linear RGB of each pixel, float32, H W 3.

    Args:
        blobs: patches under road users, B 7: x, y [m], cosine and sine of the heading, half length, half
            width, height of the ground [m].
    """
    # One long body, because some thirty scalars of a pixel are shared by its steps.
    seen, rays, origin = sight
    corners, normals, material, tint, uv = surfaces
    label, albedo, _, _, kind, glass, glow, _, _ = materials
    sun, sun_light, sky_light, sky_gain = light
    sunlit, s0, d0, cell = shadows
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
            # At the horizon a neighbour's triangle can be edge on, with its plane behind the camera: no haze
            # there.
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
            # Texture finer than a pixel averages out: its contrast fades with distance.
            fade = min(1.0, 22.0 / max(t, 1.0)) if kind[m] != 4 else 1.0
            gain = 1.0 + (gain - 1.0) * fade
            mirror = max(glass[m], pane)
            lit = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 0.0)
            if kind[m] == 3:  # leaves face all directions: a crown is lit more evenly than its outline
                lit = (0.25 + 0.45 * lit) * (0.5 + value_noise(su * 1.7, sv * 1.7))
            shade, ambient = 1.0, 0.55 + 0.45 * nz
            lab = label[m]
            if lab == 0 or lab == 1 or lab == 9:
                a, b2 = int((su - s0) / cell), int((sv - d0) / cell)
                if 0 <= a < sunlit.shape[0] - 1 and 0 <= b2 < sunlit.shape[1] - 1:
                    fa, fb = (su - s0) / cell - a, (sv - d0) / cell - b2
                    shade = (sunlit[a, b2] * (1 - fa) + sunlit[a + 1, b2] * fa) * (1 - fb) + (
                        sunlit[a, b2 + 1] * (1 - fa) + sunlit[a + 1, b2 + 1] * fa
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
                cr, cg, cb, share = 1.0, 1.0, 1.0, 0.10
                if rz > 0:
                    cr, cg, cb = _sky(rx, ry, rz, sun[0], sun[1], sun[2])
                    share = 0.55
                r += strength * share * cr * sky_gain + glow[m] * tint[k, 0] * albedo[m, 0]
                g += strength * share * cg * sky_gain + glow[m] * tint[k, 1] * albedo[m, 1]
                b += strength * share * cb * sky_gain + glow[m] * tint[k, 2] * albedo[m, 2]
            haze = 1.0 - np.exp(-t / 900.0)
            out[i, j, 0] = r + (0.72 * sky_gain - r) * haze
            out[i, j, 1] = g + (0.78 * sky_gain - g) * haze
            out[i, j, 2] = b + (0.86 * sky_gain - b) * haze
    return out


@no_type_check
@_fast
def developed(linear, exposure, grain, noise, curve):
    """8-bit BGR of a linear RGB image: vignetting, gamma by a table of 4097 values, noise."""
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

"""What a camera sees: exact visibility per pixel by ray casting, light, texture, optics, noise, JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numba
import numpy as np
from jaxtyping import Float, Int32

from pipeline.geometry.cameras import Camera
from pipeline.simulate.casting import Moment
from pipeline.simulate.materials import TABLE, texture, value_noise

__all__ = ["View", "encode_jpeg", "render", "view_of"]

_GROUND_LABELS: Final = (0, 1, 9)


@dataclass(frozen=True, eq=False)
class View:
    """Triangle seen by each pixel, at half size (`coarse`) and at full size, and the rays behind it."""

    coarse: Int32[np.ndarray, "h w"]
    full: Int32[np.ndarray, "H W"]
    rays_map: Float[np.ndarray, "H W 3"]
    origin: Float[np.ndarray, " 3"]


@lru_cache(maxsize=8)
def _rays(model: str, K: tuple[float, ...], D: tuple[float, ...], width: int, height: int) -> np.ndarray:
    camera = Camera(model, np.array(K).reshape(3, 3), np.array(D), width, height)
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return camera.unproject(np.stack([u, v], -1)).astype(np.float32)


def _rays_of(camera: Camera) -> np.ndarray:
    return _rays(camera.model, tuple(camera.K.ravel()), tuple(camera.D), camera.width_px, camera.height_px)


def view_of(moment: Moment, camera: Camera, T_map_camera: Float[np.ndarray, "4 4"]) -> View:
    """Cast every pixel of the half-size image, then those of the full image whose surroundings at half size differ."""
    R = T_map_camera[:3, :3].astype(np.float32)
    origin = (T_map_camera[:3, 3] - moment.standing.origin).astype(np.float32)
    half = _rays_of(camera.scaled(0.5)) @ R.T
    full = _rays_of(camera) @ R.T
    coarse = _seen(moment, origin, half.reshape(-1, 3)).reshape(half.shape[:2])
    guess, unsure = _upsampled(coarse, _surfaces(moment), camera.height_px, camera.width_px)
    guess.reshape(-1)[unsure] = _seen(moment, origin, full.reshape(-1, 3)[unsure])
    return View(coarse, guess, full, origin)


def _seen(moment: Moment, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    return moment.cast(np.broadcast_to(origin, rays.shape), rays, np.zeros(len(rays), np.float32)).triangle


def _surfaces(moment: Moment) -> np.ndarray:
    """A number per triangle that neighbours on one smooth surface share (material, body, tint); last row: the sky."""
    mesh = moment.mesh
    tint = (mesh.tint[:, 0] * 977 + mesh.tint[:, 2] * 131).astype(np.int64)
    return np.append((mesh.instance.astype(np.int64) * 64 + mesh.material) * 4096 + tint, -1)


@numba.njit(cache=True)
def _upsampled(
    coarse: np.ndarray, surface: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
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


def render(
    moment: Moment, view: View, sun: Float[np.ndarray, " 3"], rng: np.random.Generator, *, night: bool = False
) -> np.ndarray:
    """BGR image, uint8."""
    mesh, shadows = moment.mesh, moment.standing.shadows
    # Sun and sky add up to about 1 on a white surface facing the sun; at night only a street-lamp glow is left.
    sun_light, sky_light = (0.02, 0.10) if night else (0.95, 0.42)
    blobs = np.array(
        [_footprint(a.T_map_actor, moment.standing.origin, a.kind) for a in moment.actors], np.float32
    ).reshape(-1, 8)
    image = _shade(
        view.full, view.rays_map, view.origin, mesh.corners, moment.normals, mesh.material, mesh.tint, mesh.uv,
        TABLE.albedo, TABLE.texture, TABLE.glass, TABLE.glow, TABLE.label,
        sun.astype(np.float32), sun_light, sky_light, shadows.light, shadows.s0, shadows.d0, shadows.cell_m, blobs,
    )  # fmt: skip
    exposure = 1.55 * rng.uniform(0.9, 1.12) * (3.2 if night else 1.0)
    return _exposed(image, exposure, 7.0 if night else 2.2, rng)


def _footprint(T_map_actor: np.ndarray, origin: np.ndarray, kind: str) -> list[float]:
    """Soft dark patch that a body throws on the ground: x, y, cos, sin, half length, half width, height, -."""
    sizes = {
        "car": (2.2, 0.9),
        "van": (2.8, 1.0),
        "truck": (5.5, 1.25),
        "bus": (5.9, 1.27),
        "cyclist": (0.9, 0.25),
        "pedestrian": (0.3, 0.3),
    }
    half_length, half_width = sizes[kind]
    x, y, z = T_map_actor[:3, 3] - origin
    return [x, y, T_map_actor[0, 0], T_map_actor[1, 0], half_length, half_width, z, 0.0]


@numba.njit(cache=True, fastmath=True)
def _sky(x: float, y: float, z: float, sx: float, sy: float, sz: float) -> tuple[float, float, float]:
    """Sky radiance (r, g, b) of a direction: gradient, clouds, glow around the sun."""
    up = max(z, 0.0)
    a = np.sqrt(up)
    r, g, b = 0.74 - 0.52 * a, 0.80 - 0.40 * a, 0.88 - 0.18 * a
    if up > 0.01:
        px, py = x / (up + 0.12), y / (up + 0.12)
        n = (
            0.55 * value_noise(px * 1.3 + 31, py * 1.3)
            + 0.3 * value_noise(px * 3.1, py * 3.1 + 9)
            + 0.15 * value_noise(px * 7.0, py * 7.0)
        )
        cloud = min(max((n - 0.5) * 4.0, 0.0), 1.0) * min(up * 8.0, 1.0)
        r, g, b = r + (0.92 - r) * cloud, g + (0.92 - g) * cloud, b + (0.93 - b) * cloud
    glow = max(x * sx + y * sy + z * sz, 0.0) ** 24
    return r + 0.5 * glow, g + 0.45 * glow, b + 0.35 * glow


@numba.njit(cache=True, fastmath=True)
def _shade(
    seen, rays, origin, corners, normals, material, tint, uv, albedo, kind, glass, glow, label,
    sun, sun_light, sky_light, light, s0, d0, cell, blobs,
):  # fmt: skip
    """Linear RGB of each pixel."""
    height, width = seen.shape
    out = np.empty((height, width, 3), np.float32)
    sky_gain = sky_light + sun_light * 0.62
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
            t = (e2x * qx + e2y * qy + e2z * qz) * inv
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


@lru_cache(maxsize=1)
def _grain() -> np.ndarray:
    """Unit noise to cut windows from; drawing normals for each pixel of each frame would cost more than the rays."""
    return np.random.default_rng(5).standard_normal((1400, 2400, 3), dtype=np.float32)


@lru_cache(maxsize=1)
def _gamma() -> np.ndarray:
    """8-bit value of a linear one in 4096 steps."""
    return (255.0 * np.linspace(0, 1, 4097) ** (1 / 2.2)).astype(np.float32)


def _exposed(linear: np.ndarray, exposure: float, noise_8bit: float, rng: np.random.Generator) -> np.ndarray:
    """Optics (point spread, vignetting), sensor noise, gamma, 8 bits; RGB in, BGR out."""
    h, w = linear.shape[:2]
    blurred = cv2.GaussianBlur(linear, (3, 3), 0.55)
    a, b = int(rng.integers(0, 1400 - h + 1)), int(rng.integers(0, 2400 - w + 1))
    return _developed(
        blurred, np.float32(exposure), _grain()[a : a + h, b : b + w], np.float32(noise_8bit), _gamma()
    )


@numba.njit(cache=True, fastmath=True)
def _developed(
    linear: np.ndarray, exposure: float, grain: np.ndarray, noise: float, curve: np.ndarray
) -> np.ndarray:
    h, w, _ = linear.shape
    out = np.empty((h, w, 3), np.uint8)
    for i in range(h):
        y = 2.0 * i / (h - 1) - 1.0
        for j in range(w):
            x = 2.0 * j / (w - 1) - 1.0
            gain = exposure * (1.0 - 0.22 * (x * x + 0.35 * y * y)) * 4096.0
            for c in range(3):
                value = curve[int(min(linear[i, j, c] * gain, 4096.0))]
                # Shot noise is largest in the shadows after the gamma.
                value += grain[i, j, c] * noise * (1.35 - value / 255.0)
                out[i, j, 2 - c] = min(max(value, 0.0), 255.0)
    return out


def encode_jpeg(image_bgr: np.ndarray, quality: int) -> bytes:
    """JPEG bytes."""
    return cv2.imencode(".jpg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()

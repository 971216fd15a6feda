"""What a camera sees: exact visibility per pixel by ray casting, light, texture, optics, noise, JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Int32

from pipeline.geometry.cameras import Camera
from pipeline.simulate.sensors.pixels import upsampled
from pipeline.simulate.sensors.shading import Light, Materials, Shadows, Sight, Surfaces, developed, shade
from pipeline.simulate.world.casting import Moment
from pipeline.simulate.world.materials import TABLE

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
    guess, unsure = upsampled(coarse, _surfaces(moment), camera.height_px, camera.width_px)
    guess.reshape(-1)[unsure] = _seen(moment, origin, full.reshape(-1, 3)[unsure])
    return View(coarse, guess, full, origin)


def _seen(moment: Moment, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    return moment.cast(np.broadcast_to(origin, rays.shape), rays, np.zeros(len(rays), np.float32)).triangle


def _surfaces(moment: Moment) -> np.ndarray:
    """A number per triangle that neighbours on one smooth surface share (material, body, tint); last row: the sky."""
    mesh = moment.mesh
    tint = (mesh.tint[:, 0] * 977 + mesh.tint[:, 2] * 131).astype(np.int64)
    return np.append((mesh.instance.astype(np.int64) * 64 + mesh.material) * 4096 + tint, -1)


def render(
    moment: Moment, view: View, sun: Float[np.ndarray, " 3"], rng: np.random.Generator, *, night: bool = False
) -> np.ndarray:
    """BGR image, uint8."""
    mesh, shadows = moment.mesh, moment.standing.shadows
    # Sun and sky add up to about 1 on a white surface facing the sun; at night only a street-lamp glow is left.
    sun_light, sky_light, sky_radiance = (0.01, 0.06, 0.006) if night else (0.95, 0.42, 1.0)
    patches = np.array(
        [_footprint(a.T_map_actor, moment.standing.origin, a.kind) for a in moment.actors], np.float32
    ).reshape(-1, 8)
    image = shade(
        Sight(view.full, view.rays_map, view.origin),
        Surfaces(mesh.corners, moment.normals, mesh.material, mesh.tint, mesh.uv),
        Materials(TABLE.albedo, TABLE.texture, TABLE.glass, TABLE.glow, TABLE.label),
        Light(sun.astype(np.float32), sun_light, sky_light, sky_radiance),
        Shadows(shadows.light, shadows.s0, shadows.d0, shadows.cell_m, patches),
    )
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
    return developed(
        blurred, np.float32(exposure), _grain()[a : a + h, b : b + w], np.float32(noise_8bit), _gamma()
    )


def encode_jpeg(image_bgr: np.ndarray, quality: int) -> bytes:
    """JPEG bytes."""
    return cv2.imencode(".jpg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()

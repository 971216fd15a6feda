"""Camera images: exact visibility per pixel by ray casting, light, texture, optics, noise, JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Final, NamedTuple, no_type_check

import cv2
import numba
import numpy as np
from jaxtyping import Float, Float64, Int32

from pipeline.rig.cameras import Camera
from pipeline.simulate.sensors.shading import Light, Sight, Surfaces, developed, shade
from pipeline.simulate.world.casting import Moment
from pipeline.simulate.world.drives import Motion
from pipeline.simulate.world.materials import TABLE

__all__ = ["RollingShutter", "View", "encode_jpeg", "render", "view_of"]

# Brightness changes slowly: rows of a band are lit at one time (in 30 ms / 12 oncoming cars move by some cm).
_BANDS: Final = 12
_HALF_SIZE_M: Final = {  # length and width of a body's shadow
    "car": (2.2, 0.9),
    "van": (2.8, 1.0),
    "truck": (5.5, 1.25),
    "bus": (5.9, 1.27),
    "cyclist": (0.9, 0.25),
    "pedestrian": (0.3, 0.3),
}


@dataclass(frozen=True, eq=False)
class RollingShutter:
    """Rows are exposed from top to bottom during `readout_s`, the middle of the image at the frame's time."""

    ego: Motion
    T_vehicle_camera: np.ndarray
    readout_s: float

    def delays_s(self, rows: int) -> Float64[np.ndarray, " H"]:
        """Times of an image's rows after the frame's."""
        return ((np.arange(rows) + 0.5) / rows - 0.5) * self.readout_s

    def poses(self, t_s: float, rows: int) -> Float64[np.ndarray, "H 4 4"]:
        """T_map_camera of each row of an image taken at `t_s` of the drive."""
        return np.asarray(self.ego.poses(t_s + self.delays_s(rows)) @ self.T_vehicle_camera)


@dataclass(frozen=True, eq=False)
class View:
    """Visible triangle per pixel, at half size (`coarse`) and at full size, and the rays.

    All rays start at `origin`; with a rolling shutter, those of the middle row.
    """

    coarse: Int32[np.ndarray, "h w"]
    full: Int32[np.ndarray, "H W"]
    rays_map: Float[np.ndarray, "H W 3"]
    origin: Float[np.ndarray, " 3"]
    shutter: RollingShutter | None = None


@lru_cache(maxsize=32)  # six cameras at two sizes, and another vehicle's
def _rays(model: str, K: tuple[float, ...], D: tuple[float, ...], width: int, height: int) -> np.ndarray:
    camera = Camera(model, np.array(K).reshape(3, 3), np.array(D), width, height)
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return camera.unproject(np.stack([u, v], -1)).astype(np.float32)


def _rays_of(camera: Camera) -> np.ndarray:
    return _rays(camera.model, tuple(camera.K.ravel()), tuple(camera.D), camera.width_px, camera.height_px)


def view_of(
    moment: Moment,
    camera: Camera,
    T_map_camera: Float[np.ndarray, "4 4"],
    shutter: RollingShutter | None = None,
) -> View:
    """Cast all pixels of the half-size image, then full-size pixels whose half-size neighbourhoods differ.

    With a rolling shutter every ray starts at the camera's position when its row is exposed, in the world at
    that time; `T_map_camera` is the pose for the middle row.
    """
    half, full = (_aimed(moment, c, T_map_camera, shutter) for c in (camera.scaled(0.5), camera))
    height, width = half.rays.shape[:2]
    coarse = _seen(moment, half, np.arange(height * width)).reshape(height, width)
    guess, unsure = _upsampled(coarse, _surfaces(moment), camera.height_px, camera.width_px)
    guess.reshape(-1)[unsure] = _seen(moment, full, unsure)
    origin = (T_map_camera[:3, 3] - moment.standing.origin).astype(np.float32)
    return View(coarse, guess, full.rays, origin, shutter)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _upsampled(coarse, surface, height, width):  # noqa: ANN001, ANN202 - compiled
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


class _Aimed(NamedTuple):
    """Directions of all pixels in the map; start of each row's rays from the moment's origin, and its delay."""

    rays: np.ndarray
    start: np.ndarray
    delay_s: np.ndarray


def _aimed(
    moment: Moment, camera: Camera, T_map_camera: np.ndarray, shutter: RollingShutter | None
) -> _Aimed:
    rows = camera.height_px
    if shutter is None:
        R = T_map_camera[:3, :3].astype(np.float32)
        origin = (T_map_camera[:3, 3] - moment.standing.origin).astype(np.float32)
        return _Aimed(_rays_of(camera) @ R.T, np.broadcast_to(origin, (rows, 3)), np.zeros(rows, np.float32))
    T = shutter.poses(moment.t_s, rows)
    origin = (T[:, :3, 3] - moment.standing.origin).astype(np.float32)
    rays = np.einsum("hij,hwj->hwi", T[:, :3, :3].astype(np.float32), _rays_of(camera))
    return _Aimed(rays, origin, shutter.delays_s(rows).astype(np.float32))


def _seen(moment: Moment, aimed: _Aimed, pixels: np.ndarray) -> np.ndarray:
    row = pixels // aimed.rays.shape[1]
    return moment.cast(aimed.start[row], aimed.rays.reshape(-1, 3)[pixels], aimed.delay_s[row]).triangle


def _surfaces(moment: Moment) -> np.ndarray:
    """Id per triangle, shared by neighbours on a smooth surface (material, body, tint); last row: sky."""
    mesh = moment.mesh
    tint = (mesh.tint[:, 0] * 977 + mesh.tint[:, 2] * 131).astype(np.int64)
    return np.append((mesh.instance.astype(np.int64) * 64 + mesh.material) * 4096 + tint, -1)


def render(
    moment: Moment, view: View, sun: Float[np.ndarray, " 3"], rng: np.random.Generator, *, night: bool = False
) -> np.ndarray:
    """BGR image, uint8."""
    # Sun and sky sum to about 1 on a white surface facing the sun; at night only a street-lamp glow remains.
    day = (0.0, 0.5, 1.0) if moment.landscape.ceiling_m else (0.95, 0.42, 1.0)
    light = Light(sun.astype(np.float32), *((0.01, 0.06, 0.006) if night else day))
    if view.shutter is None:
        image = _lit(moment, Sight(view.full, view.rays_map, view.origin), light)
    else:
        image = _lit_in_bands(moment, view, view.shutter, light)
    exposure = 1.55 * rng.uniform(0.9, 1.12) * (3.2 if night else 1.0)
    return _exposed(image, exposure, 7.0 if night else 2.2, rng)


def _lit_in_bands(moment: Moment, view: View, shutter: RollingShutter, light: Light) -> np.ndarray:
    """Rows exposed together are rendered with light and bodies at their own time."""
    rows = len(view.full)
    delays, T_map_camera = shutter.delays_s(rows), shutter.poses(moment.t_s, rows)
    parts = []
    for first, last in pairwise(np.linspace(0, rows, _BANDS + 1).round().astype(int).tolist()):
        middle = (first + last) // 2
        origin = (T_map_camera[middle, :3, 3] - moment.standing.origin).astype(np.float32)
        sight = Sight(view.full[first:last], view.rays_map[first:last], origin)
        parts.append(_lit(moment.advanced(moment.t_s + float(delays[middle])), sight, light))
    return np.concatenate(parts)


def _lit(moment: Moment, sight: Sight, light: Light) -> np.ndarray:
    mesh = moment.mesh
    patches = []  # soft dark ones under bodies on the ground
    for actor in moment.actors:
        x, y, z = actor.T_map_actor[:3, 3] - moment.standing.origin
        patches.append([x, y, *actor.T_map_actor[:2, 0], *_HALF_SIZE_M[actor.kind], z])
    surfaces = Surfaces(mesh.corners, moment.normals, mesh.material, mesh.tint, mesh.uv)
    blobs = np.array(patches, np.float32).reshape(-1, 7)
    return shade(sight, surfaces, TABLE, light, moment.standing.shadows, blobs)


@lru_cache(maxsize=1)
def _grain() -> np.ndarray:
    """Unit noise to take windows from, because drawing it per frame would cost more than the rays."""
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

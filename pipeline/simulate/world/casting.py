"""Ray casting: Embree on a sliding window of the static world and on each road user separately.

For road users, rays are transformed to the user's frame at the ray's own time. A sweep of 100 ms thus hits
each user where it was when the beam passed, and no mesh is rebuilt per frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Final, NamedTuple, no_type_check

import numba
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float

from pipeline.core.rows import join_rows
from pipeline.simulate.world.actors import actor_mesh
from pipeline.simulate.world.drives import Drive
from pipeline.simulate.world.landscapes import LANDSCAPES, Landscape
from pipeline.simulate.world.meshes import CHUNK_M, Chunk, Mesh, placed
from pipeline.simulate.world.street import (
    add_asphalt,
    add_halls,
    add_motorway,
    add_plots,
    add_rows,
    add_street,
)
from pipeline.simulate.world.traffic import Actor, actors_at

__all__ = ["Hits", "Moment", "ShadowMap", "Standing", "World", "chunk_mesh", "standing_of"]

_AHEAD_M: Final = 170.0
_BEHIND_M: Final = 60.0
_SHADOWS_BEHIND_M: Final = 8.0  # of an ordinary window: cameras that look ahead see no others
_ONE_PLACE_M: Final = 6.0  # rays whose origins are further apart than a car moves in a sweep form no cone
_POPULATED_M, _UNPOPULATED_M = 150.0, 15.0  # road users ahead; the last stretch behind that is empty


@dataclass(frozen=True, eq=False)
class Hits:
    """Hits of N rays: range, row of the moment's triangles (-1 = nothing), barycentric coordinates."""

    range_m: np.ndarray
    triangle: np.ndarray
    barycentric: np.ndarray


class ShadowMap(NamedTuple):
    """Sunlight (0 = shadow) on the ground by arc length and offset."""

    light: np.ndarray
    s0: float
    d0: float
    cell_m: float


@dataclass(frozen=True, eq=False)
class Standing:
    """The static world around the vehicle, in map coordinates minus `origin` (float32: 0.1 mm near 0)."""

    origin: np.ndarray
    mesh: Mesh
    scene: EmbreeScene
    shadows: ShadowMap
    normals: np.ndarray


class World:
    """The world of one drive; holds one window of it at a time, up to a distance behind the vehicle."""

    def __init__(self, drive: Drive, behind_m: float = _BEHIND_M) -> None:
        self.drive, self._behind_m = drive, behind_m
        self._chunks: dict[int, Mesh] = {}
        self._window: tuple[int, int] | None = None
        self._standing: Standing | None = None

    def around(self, s_m: float) -> Standing:
        """The static world up to 170 m ahead of an arc length."""
        window = int((s_m - self._behind_m) // CHUNK_M), int((s_m + _AHEAD_M) // CHUNK_M)
        if self._standing is None or window != self._window:
            self._chunks = {
                i: self._chunks.get(i) or chunk_mesh(self.drive, i) for i in range(window[0], window[1] + 1)
            }
            origin = np.round(self.drive.road.to_map(np.array([[s_m, 0.0, 0.0]]))[0])
            mesh, road = join_rows(list(self._chunks.values())), self.drive.road
            shadows_behind_m = _SHADOWS_BEHIND_M + self._behind_m - _BEHIND_M
            self._window = window
            self._standing = standing_of(mesh, origin, self.drive.sun, road.to_map, s_m, shadows_behind_m)
        return self._standing

    def moment(self, t_s: float) -> Moment:
        """The world at a time of the drive."""
        standing = self.around(self.drive.ego.arc(t_s))
        within_m = self._behind_m - _UNPOPULATED_M, _POPULATED_M
        return Moment(standing, actors_at(self.drive, t_s, within_m), t_s, self.drive.landscape)


@dataclass(frozen=True, eq=False)
class Moment:
    """The world at one time; for rays at other times, road users move with constant velocity."""

    standing: Standing
    actors: list[Actor]
    t_s: float
    landscape: Landscape = LANDSCAPES["urban"]

    def advanced(self, t_s: float) -> Moment:
        """The world some milliseconds later or earlier."""
        return replace(self, actors=[a.advanced(t_s - self.t_s) for a in self.actors], t_s=t_s)

    @cached_property
    def mesh(self) -> Mesh:
        """All triangles, in map coordinates minus the window's origin: static ones, then actor by actor."""
        parts = [self.standing.mesh]
        for actor in self.actors:
            T = actor.T_map_actor.copy()
            T[:3, 3] -= self.standing.origin
            parts.append(placed(actor_mesh(actor.kind, actor.variant), T, actor.key))
        return join_rows(parts)

    @cached_property
    def normals(self) -> Float[np.ndarray, "T 3"]:
        """Unit normals of the triangles, of either side."""
        turned = (
            _prototype(a.kind, a.variant).normals @ a.T_map_actor[:3, :3].T.astype(np.float32)
            for a in self.actors
        )
        return np.concatenate([self.standing.normals, *turned])

    @cached_property
    def velocity_of_triangle(self) -> Float[np.ndarray, "T 3"]:
        """Velocity in the map [m/s]."""
        velocities = np.array([np.zeros(3), *(a.velocity_map for a in self.actors)], np.float32)
        return np.repeat(velocities, self._sizes, axis=0)

    @cached_property
    def _sizes(self) -> list[int]:
        """Triangles of the static world, and of every actor."""
        return [len(self.standing.mesh), *(len(actor_mesh(a.kind, a.variant)) for a in self.actors)]

    def cast(
        self,
        origins: Float[np.ndarray, "N 3"],
        directions: Float[np.ndarray, "N 3"],
        delay_s: Float[np.ndarray, " N"],
    ) -> Hits:
        """First hits of rays in map coordinates minus the window's origin, `delay_s` after this moment."""
        origins = np.ascontiguousarray(origins, np.float32)
        directions = np.ascontiguousarray(directions, np.float32)
        delay = delay_s.astype(np.float32)
        range_m, triangle, barycentric = _cast(self.standing.scene, origins, directions)
        axis, cosine = _cone(directions)
        if np.ptp(origins, axis=0).max() > _ONE_PLACE_M:
            cosine = -1.0
        for actor, start in zip(self.actors, np.cumsum(self._sizes)[:-1].tolist(), strict=True):
            proto = _prototype(actor.kind, actor.variant)
            R, v = actor.T_map_actor[:3, :3].astype(np.float32), actor.velocity_map.astype(np.float32)
            p = (actor.T_map_actor[:3, 3] - self.standing.origin).astype(np.float32)
            centre = p + R @ proto.centre
            if not _may_be_seen(centre - origins[0], proto.reach_m + 3.0, axis, cosine):
                continue
            near = _rays_near(origins, directions, delay, centre, v, np.float32(proto.reach_m), range_m)
            if not near.size:
                continue
            o = (origins[near] - p - v * delay[near, None]) @ R
            r, k, b = _cast(proto.scene, o, directions[near] @ R)
            closer = r < range_m[near]
            hit = near[closer]
            range_m[hit], triangle[hit], barycentric[hit] = r[closer], k[closer] + start, b[closer]
        return Hits(range_m, triangle, barycentric)


@dataclass(frozen=True, eq=False)
class _Prototype:
    """An actor's scene and normals in its own frame, and its bounding sphere."""

    scene: EmbreeScene
    normals: np.ndarray
    reach_m: float
    centre: np.ndarray


@lru_cache(maxsize=256)
def _prototype(kind: str, variant: int) -> _Prototype:
    mesh = actor_mesh(kind, variant)
    points = mesh.corners.reshape(-1, 3)
    centre = (points.min(0) + points.max(0)) / 2
    reach = float(np.linalg.norm(points - centre, axis=1).max())
    return _Prototype(_scene(mesh), _normals(mesh.corners), reach, centre.astype(np.float32))


def _normals(corners: np.ndarray) -> np.ndarray:
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def _cone(directions: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean direction of unit vectors, and cosine of the largest angle from it."""
    axis = directions[:: max(len(directions) // 512, 1)].mean(0)
    axis /= max(float(np.linalg.norm(axis)), 1e-6)
    return axis, float((directions @ axis).min())


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _rays_near(origins, directions, delay, centre, velocity, radius, limit):  # noqa: ANN001, ANN202 - compiled
    """Indices of the rays (unit vectors) that pass within `radius` of a moving point, before their `limit`.

    `delay` is the time of each ray after that of `centre` [s].
    """
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


def _may_be_seen(centre: np.ndarray, reach_m: float, axis: np.ndarray, cosine: float) -> bool:
    """True if a sphere may intersect a cone of rays from the origin."""
    distance = float(np.linalg.norm(centre))
    if distance <= reach_m or cosine < 0:
        return True
    widest = np.arccos(np.clip(cosine, -1, 1)) + np.arcsin(reach_m / distance)
    return bool(np.arccos(np.clip(centre @ axis / distance, -1, 1)) < widest)


def _scene(mesh: Mesh) -> EmbreeScene:
    scene = EmbreeScene()
    corners = np.ascontiguousarray(mesh.corners.reshape(-1, 3), np.float32)
    # The scene holds a reference to the mesh.
    TriangleMesh(scene, corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
    return scene


def _cast(
    scene: EmbreeScene, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range (inf = no hit), triangle (-1 = no hit) and barycentric coordinates of each ray's first hit."""
    found = scene.run(
        np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32), output=True
    )
    triangle = found["primID"]
    range_m = np.where(triangle < 0, np.float32(np.inf), found["tfar"])
    return range_m, triangle, np.stack([found["u"], found["v"]], axis=1)


def standing_of(
    mesh: Mesh, origin: np.ndarray, sun: np.ndarray, to_map: Callable[[np.ndarray], np.ndarray], s_m: float,
    shadows_behind_m: float = _SHADOWS_BEHIND_M,
) -> Standing:  # fmt: skip
    """A static world from a mesh in the map, with sunlight on the ground around an arc length."""
    local = replace(mesh, corners=mesh.corners - origin.astype(np.float32))
    scene, cell, half, s0 = _scene(local), 0.4, 22.0, s_m - shadows_behind_m
    # Once per window, not per image: shadow rays from 0.2 m above the road.
    s, d = np.meshgrid(np.arange(s0, s_m + 95.0, cell), np.arange(-half, half, cell), indexing="ij")
    ground = to_map(np.stack([s.ravel(), d.ravel(), np.full(s.size, 0.2)], 1)) - origin
    _, hit, _ = _cast(scene, ground, np.broadcast_to(sun, ground.shape))
    light = np.where(hit >= 0, np.float32(0.0), np.float32(1.0)).reshape(s.shape)
    return Standing(origin, local, scene, ShadowMap(light, s0, -half, cell), _normals(local.corners))


def chunk_mesh(drive: Drive, index: int) -> Mesh:
    """The static world between arc lengths `index * CHUNK_M` and `(index + 1) * CHUNK_M`, in the map."""
    chunk = Chunk(drive, index, np.random.default_rng([drive.seed, 31, index + 1000]))
    add_asphalt(chunk)
    if drive.landscape.ceiling_m:
        add_halls(chunk)
    elif drive.landscape.fast:
        add_motorway(chunk)
    elif drive.landscape.plain:
        add_street(chunk)
    else:
        add_plots(chunk)
    if not drive.landscape.plain:
        add_rows(chunk)
    flat = chunk.along.mesh()
    bent = drive.road.to_map(flat.corners.astype(np.float64)).astype(np.float32)
    return join_rows([replace(flat, corners=bent), *chunk.rigid])

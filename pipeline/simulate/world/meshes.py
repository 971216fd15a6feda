"""Triangle meshes with material, tint, instance and texture coordinates per triangle, their builder; a road's piece."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from pipeline.core.rows import join_rows, take_rows
from pipeline.simulate.world.drives import Drive
from pipeline.simulate.world.materials import material

__all__ = ["CHUNK_M", "Chunk", "Colour", "Mesh", "MeshBuilder", "Number", "Span", "placed"]

# Integers are numbers too: beartype does not take them for floats.
Number = float | int
Colour = tuple[Number, Number, Number]

_WHITE = (1.0, 1.0, 1.0)
# Corner order of a hexahedron's faces; 0-3 bottom, 4-7 top, each (x0 y0), (x1 y0), (x1 y1), (x0 y1).
_FACES = {
    "bottom": (3, 2, 1, 0),
    "top": (4, 5, 6, 7),
    "front": (1, 2, 6, 5),
    "rear": (3, 0, 4, 7),
    "left": (2, 3, 7, 6),
    "right": (0, 1, 5, 4),
}


@dataclass(frozen=True, eq=False)
class Mesh:
    """T triangles; all arrays have T rows."""

    corners: np.ndarray  # T 3 3 [m]
    material: np.ndarray  # T, uint8
    tint: np.ndarray  # T 3, multiplies the material's albedo
    uv: np.ndarray  # T 3 2 [m]
    instance: np.ndarray  # T, int32; 0 = part of the scenery

    def __len__(self) -> int:
        """Number of triangles."""
        return len(self.material)


def placed(mesh: Mesh, T_map_mesh: Float[np.ndarray, "4 4"], instance: int | None = None) -> Mesh:
    """The mesh moved rigidly; one instance if a number is given."""
    corners = mesh.corners @ T_map_mesh[:3, :3].T.astype(np.float32) + T_map_mesh[:3, 3].astype(np.float32)
    ids = mesh.instance if instance is None else np.full(len(mesh), instance, np.int32)
    return replace(mesh, corners=corners, instance=ids)


@dataclass
class MeshBuilder:
    """Collects quads; all shapes consist of them."""

    _parts: list[Mesh] = field(default_factory=list)

    def quads(
        self, corners: np.ndarray, name: str, tint: Colour = _WHITE, uv: np.ndarray | None = None
    ) -> None:
        """Add Q quads (Q 4 3); uv (Q 4 2) defaults to lengths along the first and the last edge."""
        c = np.asarray(corners, np.float32).reshape(-1, 4, 3)
        if uv is None:
            along, up = (np.linalg.norm(c[:, k] - c[:, 0], axis=1) for k in (1, 3))
            o = np.zeros_like(along)
            uv = np.stack([o, o, along, o, along, up, o, up], 1)
        w = np.asarray(uv, np.float32).reshape(-1, 4, 2)
        n = 2 * len(c)
        self._parts.append(
            Mesh(
                np.concatenate([c[:, [0, 1, 2]], c[:, [0, 2, 3]]]),
                np.full(n, material(name), np.uint8),
                np.broadcast_to(np.asarray(tint, np.float32), (n, 3)),
                np.concatenate([w[:, [0, 1, 2]], w[:, [0, 2, 3]]]),
                np.zeros(n, np.int32),
            )
        )

    def frustum(
        self,
        bottom: tuple[Number, Number, Number, Number, Number],
        top: tuple[Number, Number, Number, Number, Number],
        faces: dict[str, str] | str,
        tint: Colour = _WHITE,
    ) -> None:
        """Add a block between two level rectangles (x0, x1, y0, y1, z); `faces` has materials of some or all."""
        corners = []
        for x0, x1, y0, y1, z in (bottom, top):
            corners += [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]
        for face, name in (dict.fromkeys(_FACES, faces) if isinstance(faces, str) else faces).items():
            self.quads(np.array(corners, np.float32)[list(_FACES[face])], name, tint)

    def box(
        self,
        centre: tuple[Number, Number, Number],
        size: tuple[Number, Number, Number],
        name: str,
        tint: Colour = _WHITE,
    ) -> None:
        """Add an upright box."""
        (x, y, z), (a, b, c) = centre, (size[0] / 2, size[1] / 2, size[2] / 2)
        self.frustum((x - a, x + a, y - b, y + b, z - c), (x - a, x + a, y - b, y + b, z + c), name, tint)

    def tube(
        self, a: np.ndarray, b: np.ndarray, radius_m: float, name: str, sides: int = 6, tint: Colour = _WHITE
    ) -> None:
        """Add a closed tube from a to b."""
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        axis = (b - a) / np.linalg.norm(b - a)
        side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        phi = np.linspace(0, 2 * np.pi, sides + 1)
        ring = radius_m * (np.cos(phi)[:, None] * side + np.sin(phi)[:, None] * other)
        low, high = a + ring, b + ring
        self.quads(np.stack([low[:-1], low[1:], high[1:], high[:-1]], 1), name, tint)
        for centre, rim in ((a, low), (b, high)):
            c = np.broadcast_to(centre, (sides, 3))
            self.quads(np.stack([c, rim[:-1], rim[1:], c], 1), name, tint)

    def blob(
        self, centre: np.ndarray, radii: np.ndarray, name: str, rng: np.random.Generator,
        tint: Colour = _WHITE,
    ) -> None:  # fmt: skip
        """Add a lumpy ellipsoid: tree crown, bush, head."""
        lat, lon = np.linspace(-np.pi / 2, np.pi / 2, 7), np.linspace(0, 2 * np.pi, 10)
        bump = 1 + 0.16 * rng.uniform(-1, 1, (len(lat), len(lon)))
        bump[:, -1], bump[0], bump[-1] = bump[:, 0], 1.0, 1.0
        direction = np.stack(
            [
                np.outer(np.cos(lat), np.cos(lon)),
                np.outer(np.cos(lat), np.sin(lon)),
                np.outer(np.sin(lat), np.ones_like(lon)),
            ],
            -1,
        )
        p = np.asarray(centre) + direction * bump[..., None] * np.asarray(radii)
        self.quads(
            np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]], 2).reshape(-1, 4, 3), name, tint
        )

    def mesh(self, instance: int = 0) -> Mesh:
        """The triangles so far, without degenerate ones."""
        every = join_rows(self._parts)
        a, b, c = every.corners.swapaxes(0, 1)
        kept = take_rows(every, np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-8)
        return replace(kept, instance=np.full(len(kept), instance, np.int32))


CHUNK_M: Final = 40.0
Span = tuple[float, float]


@dataclass
class Chunk:
    """Two ways of adding: `along` follows the road (corners are s, d, h), `rigid` stays rigid."""

    drive: Drive
    index: int
    rng: np.random.Generator
    along: MeshBuilder = field(default_factory=MeshBuilder)
    rigid: list[Mesh] = field(default_factory=list)

    @property
    def s0(self) -> float:
        """Arc length at the start of the chunk."""
        return self.index * CHUNK_M

    @property
    def whole(self) -> Span:
        """Arc lengths at its start and its end."""
        return self.s0, self.s0 + CHUNK_M

    def strip(self, d: Span, h: Span, name: str, step: float = 5.0) -> None:
        """Add a band along the whole chunk between two offsets, in either order, and their heights."""
        (d0, h0), (d1, h1) = sorted(zip(d, h, strict=True))
        self.band(self.whole, (d0, d1), (h0, h1), name, step)

    def band(self, s: Span, d: Span, h: Span, name: str, step: float = 5.0, tint: Colour = (1, 1, 1)) -> None:
        """Add a band of a material between arc lengths `s` and lateral offsets `d` (left) at heights `h`.

        It follows the road's curve in pieces of about `step` [m]; a band steeper than 45 deg has upright
        texture.
        """
        ends = np.linspace(s[0], s[1], max(2, round((s[1] - s[0]) / step) + 1))
        n = len(ends) - 1
        corners = np.empty((n, 4, 3))
        for corner, (along, side) in enumerate(
            ((ends[:-1], 0), (ends[1:], 0), (ends[1:], 1), (ends[:-1], 1))
        ):
            corners[:, corner] = np.stack([along, np.full(n, d[side]), np.full(n, h[side])], 1)
        upright = abs(h[1] - h[0]) > abs(d[1] - d[0])
        self.along.quads(corners, name, tint, corners[..., [0, 2]] if upright else corners[..., :2])

    def wall(self, s: Span, d: float, h: Span, name: str, tint: Colour = (1, 1, 1)) -> None:
        """Add an upright band."""
        self.band(s, (d, d), h, name, 10.0, tint)

    def put(
        self, mesh: Mesh, s: float, d: float, h: float = 0.0, yaw: float = 0.0, instance: int | None = None
    ) -> None:
        """Place a rigid mesh."""
        self.rigid.append(placed(mesh, self.drive.road.pose(s, d, h, yaw), instance))

    def every(self, step: float, jitter: float = 0.0, chance: float = 1.0) -> list[float]:
        """Places along the chunk on a grid that continues in the next chunk."""
        first = int(np.ceil(self.s0 / step))
        grid = [k * step for k in range(first, int(np.ceil((self.s0 + CHUNK_M) / step)))]
        return [float(s + self.rng.uniform(-jitter, jitter)) for s in grid if self.rng.random() < chance]

"""A piece of the static world under construction: geometry that follows the road, and rigid meshes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from pipeline.simulate.world.drives import Drive
from pipeline.simulate.world.meshes import Colour, Mesh, MeshBuilder, placed

__all__ = ["CHUNK_M", "Chunk", "Span"]

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

"""Turn of a solution by one part of its evidence alone: a side of the borders, boxes, a source of a radar's pitch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["PartTurn"]


@dataclass(frozen=True)
class PartTurn:
    """Rotation from the solution to the best one by a part alone, other unknowns at the solution or as they follow.

    Args:
        scatter_rad: of the offset, by the data.
        floor_rad: of what all scenes share: labels too wide, beams too far apart, a source's own bias.
        axis: of a camera 0 pitch, 1 yaw: about its x and y; of a radar 0, its pitch.
        part_of: the part of which this is a half: it contradicts the other half alone.
    """

    name: str
    offset_rad: float
    scatter_rad: float
    floor_rad: float = 0.0
    axis: int = 0
    part_of: str = ""

    @property
    def sigma_rad(self) -> float:
        """Sigma of the offset."""
        return float(np.hypot(self.scatter_rad, self.floor_rad))

    @property
    def sentence(self) -> str:
        """Name of the part and its rotation."""
        return f"{self.name} by {np.degrees(self.offset_rad):+.2f} +- {np.degrees(self.sigma_rad):.2f} deg"

    def wider(self, sigma_rad: float) -> PartTurn:
        """The turn with an error more that its scenes share."""
        floor_rad = float(np.hypot(self.floor_rad, sigma_rad))
        return PartTurn(self.name, self.offset_rad, self.scatter_rad, floor_rad, self.axis, self.part_of)

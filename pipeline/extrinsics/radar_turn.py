"""A change of an edge as rotation of its radar: azimuth positive to the left, elevation upwards."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.rig.graph import Edge

__all__ = ["turn_of_radar"]


def turn_of_radar(edge: Edge, T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "2 3"]:
    """Matrix from the rotation vector of a change (parent's axes) to the radar's azimuth and elevation.

    A radar rotated to the left by an angle has a positive azimuth change; a radar whose software rotates its
    points to the left has a negative one.

    Args:
        edge: edge with a radar at one end; if both are radars, the child is used.
    """
    if edge.child.kind == "radar":
        axes = T[:3, :3].T  # parent's axes to the radar's
        return np.stack([axes[2], -axes[1]])
    assert edge.parent.kind == "radar", f"{edge.name} has no radar"
    return np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

"""A change of an edge as a turn of its radar: azimuth, positive to the left of its x axis, and elevation, upwards."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.rig.graph import Edge

__all__ = ["turn_of_radar"]


def turn_of_radar(edge: Edge, T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "2 3"]:
    """What takes a change's rotation vector (of T_parent_child, parent's axes) to the radar's azimuth and elevation.

    A radar that is turned to the left by an angle has turned by that azimuth; one whose software turns its points to
    the left seems to have turned to the right.

    Args:
        edge: one end is a radar; of an edge of two it is the child.
        T: T_parent_child.
    """
    if edge.child.kind == "radar":
        axes = T[:3, :3].T  # parent's axes to the radar's
        return np.stack([axes[2], -axes[1]])
    assert edge.parent.kind == "radar", f"{edge.name} has no radar"
    return np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

"""How well a sensor's directions are known from the pose of an edge, or its own in an adjusted rig."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.geometry.se3 import adjoint, inverse
from pipeline.geometry.target_sigmas import target_sigmas
from pipeline.rig.graph import Edge, RigPose

__all__ = ["direction_sigmas"]


def direction_sigmas(
    edge: Edge, T: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, " 2"]:
    """Sigmas of azimuth and elevation [rad] at targets: in the edge's parent, of a pose in the sensor itself.

    Args:
        T: T_parent_child, or T_reference_sensor.
        covariance: of its left perturbation.
    """
    if not isinstance(edge, RigPose):
        return target_sigmas(edge.kind, T, covariance)
    T_sensor_reference = inverse(T)
    A = adjoint(T_sensor_reference)
    return target_sigmas(f"{edge.child.kind}_{edge.parent.kind}", T_sensor_reference, A @ covariance @ A.T)

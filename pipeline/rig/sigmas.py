"""How well a sensor's directions are known from the pose of an edge, or its own in an adjusted rig."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.geometry.se3 import adjoint, inverse
from pipeline.geometry.target_sigmas import target_jacobian
from pipeline.rig.graph import Edge, RigPose

__all__ = ["direction_sigmas"]


def direction_sigmas(
    edge: Edge, T: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "*N 6 6"]
) -> Float[np.ndarray, "*N 2"]:
    """Sigmas of azimuth and elevation [rad] at targets: in the edge's parent, of a pose in the sensor itself.

    Args:
        T: T_parent_child, or T_reference_sensor; of several similar poses any of them.
        covariance: of left perturbations.
    """
    if isinstance(edge, RigPose):
        T_sensor_reference = inverse(T)
        J = target_jacobian(f"{edge.child.kind}_{edge.parent.kind}", T_sensor_reference)
        J = J @ adjoint(T_sensor_reference)
    else:
        J = target_jacobian(edge.kind, T)
    square = np.einsum("dti,...ij,dtj->...d", J, covariance, J, optimize=True) / J.shape[1]
    return np.asarray(np.sqrt(square))

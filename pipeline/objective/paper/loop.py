"""The paper's global loss and how it joins the pairwise ones: `(1 + L_P)(1 + L_G)`.

Source: sections 4.4 and 4.5.3, equations 1 and 2. The paper writes T_lidar^camera T_radar^lidar
T_camera^radar; in the house's names that is T_camera_lidar T_lidar_radar T_camera_radar^-1.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.rig.se3 import inverse

__all__ = ["euler_angles", "joint_objective", "loop_loss", "loop_transform"]


def loop_transform(
    T_camera_lidar: Float[np.ndarray, "*batch 4 4"],
    T_lidar_radar: Float[np.ndarray, "*batch 4 4"],
    T_camera_radar: Float[np.ndarray, "*batch 4 4"],
) -> Float[np.ndarray, "*batch 4 4"]:
    """The closed loop, identity where the three agree."""
    return T_camera_lidar @ T_lidar_radar @ inverse(T_camera_radar)


def loop_loss(T_loop: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch"]:
    """l1 norm of the loop's Euler angles [rad] and translation [m], added as they are: the paper names no units."""
    return np.asarray(np.abs(euler_angles(T_loop)).sum(-1) + np.abs(T_loop[..., :3, 3]).sum(-1))


def euler_angles(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 3"]:
    """Roll, pitch, yaw [rad] of R = Rz(yaw) Ry(pitch) Rx(roll); pitch in [-pi/2, pi/2]."""
    return np.stack(
        [
            np.arctan2(T[..., 2, 1], T[..., 2, 2]),
            -np.arcsin(np.clip(T[..., 2, 0], -1, 1)),
            np.arctan2(T[..., 1, 0], T[..., 0, 0]),
        ],
        -1,
    )


def joint_objective(
    pairwise_loss: Float[np.ndarray, "*batch"], global_loss: Float[np.ndarray, "*batch"]
) -> Float[np.ndarray, "*batch"]:
    """Equation 2."""
    return (1 + pairwise_loss) * (1 + global_loss)

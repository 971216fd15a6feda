"""Roll and pitch of a radar in any direction: floors of elevations, and errors that follow from them.

Elevations determine a radar's pitch, the tilt of its viewing direction, three times better than its roll
about that direction, and floors are stated so. Along the lidar's axes the two are mixed by the radar's yaw: a
corner radar's weak roll is not its roll about the car's axis.

Azimuths and ranges are solved with roll, pitch and z from elevations, and err with them: a roll that is a
degree off rotates yaw by 0.1 deg and shifts y by 3 cm if the matched objects are below the radar.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64

__all__ = ["along_radar", "floor_scatter", "following_tilt", "radar_tilt_axes", "tempered", "tilt_of"]


def radar_tilt_axes(T_lidar_radar: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "2 2"]:
    """Columns: the axes of roll (where the radar looks, level) and pitch (to its left), along the lidar's x and y."""
    c, s = T_lidar_radar[:2, 0] / np.hypot(*T_lidar_radar[:2, 0])
    return np.array([[c, -s], [s, c]])


def along_radar(
    T_lidar_radar: Float[np.ndarray, "4 4"], floor: Float[np.ndarray, " P"]
) -> Float[np.ndarray, "P P"]:
    """Covariance along the lidar's axes of floors whose first two are of the radar's own roll and pitch."""
    axes = np.eye(len(floor))
    axes[:2, :2] = radar_tilt_axes(T_lidar_radar)
    covariance: np.ndarray = (axes * floor**2) @ axes.T
    return covariance


def tilt_of(
    T_lidar_radar: Float[np.ndarray, "4 4"], H: Float[np.ndarray, "P P"], g: Float[np.ndarray, " P"]
) -> tuple[Float[np.ndarray, "P P"], Float[np.ndarray, " P"]]:
    """Equations whose first two unknowns are turns about the lidar's x and y, as of the radar's own roll and pitch."""
    axes = np.eye(len(g))
    axes[:2, :2] = radar_tilt_axes(T_lidar_radar)
    return axes.T @ H @ axes, g @ axes


def tempered(
    H: Float[np.ndarray, "F P P"], g: Float[np.ndarray, "F P"], floor: Float[np.ndarray, "P P"]
) -> tuple[Float[np.ndarray, "F P P"], Float[np.ndarray, "F P"]]:
    """Equations of all frames as one measurement with covariance `H^-1 + floor`, shared out among the frames."""
    # (H^-1 + F)^-1 = (1 + H F)^-1 H, which also holds where H is singular (a radar without elevation).
    W = np.linalg.inv(np.eye(len(floor)) + H.sum(0) @ floor)
    product = W @ H
    return 0.5 * (product + np.swapaxes(product, 1, 2)), g @ W.T


def floor_scatter(
    H_tempered: Float[np.ndarray, "F P P"], floor: Float[np.ndarray, "P P"]
) -> Float[np.ndarray, "P P"]:
    """Covariance of a measurement's total gradient by its floor alone: `J floor J`, with J as `tempered` left it."""
    J = H_tempered.sum(0)
    return np.asarray(J @ floor @ J)


def following_tilt(
    H: Float[np.ndarray, "P P"],
    prior_information: Float[np.ndarray, "P P"],
    follows: Int64[np.ndarray, " A"],
    given: Int64[np.ndarray, " B"],
) -> Float[np.ndarray, "P P"]:
    """Errors of all unknowns from errors of the `given` ones, which the equations H take as exact.

    `follows` are the unknowns that these equations solve for. Source: Schmidt 1966 (parameters considered,
    not solved for).
    """
    out = np.eye(len(H))
    block = np.ix_(follows, follows)
    out[np.ix_(follows, given)] = -np.linalg.solve(
        H[block] + prior_information[block], H[np.ix_(follows, given)]
    )
    return out

"""Roll and pitch of a radar that looks anywhere: floors of what elevations say of them, and what follows their errors.

A radar's elevations tell its pitch, the tilt of where it looks, three times better than its roll about that direction,
and floors are stated so. Along the lidar's axes the two are mixed as the radar is turned: a corner radar's weak roll
taken for its roll about the car's axis puts floors where they do not belong.

Azimuths and ranges are solved with roll, pitch and z as elevations have them. So they err with them: a roll that is a
degree off turns yaw by 0.1 deg and shifts y by 3 cm where what is matched lies below the radar.
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
    """How errors of all unknowns follow from errors of a solution whose equations take the `given` ones as exact.

    Args:
        H: of the equations that take them so, with their share in the `given` unknowns.
        prior_information: of the prior.
        follows: unknowns that these equations solve for.
        given: the others.

    Source: Schmidt 1966 (parameters considered, not solved for).
    """
    out = np.eye(len(H))
    block = np.ix_(follows, follows)
    out[np.ix_(follows, given)] = -np.linalg.solve(
        H[block] + prior_information[block], H[np.ix_(follows, given)]
    )
    return out

"""Errors that all frames of a day share and none shows: considered in a solution's covariance, not solved for.

Each is stated by how far it may have moved the solution (`Considered.rows`), and one formula adds all of them. They
are common to all days of a vehicle: its masks, borders and roads stay. NUISANCES has one row for each.

Source: Schmidt 1966 (considered parameters).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from pipeline.rig.evidence import EDGE

__all__ = ["NUISANCES", "Considered", "Nuisance", "by_owner", "considered_covariance", "considered_numbers"]


@dataclass(frozen=True)
class Nuisance:
    """Where an error comes from.

    Args:
        owner: kind of the sensor that brings it into all of its edges, or EDGE if it is of this pair alone.
        origin: its prior sigma and what showed it.
    """

    owner: str
    origin: str


NUISANCES: Final = {
    "masks": Nuisance("camera", "CAMERA_LIDAR_BIAS: dilation of masks, focal length, rolling shutter"),
    "positions": Nuisance(EDGE, "CAMERA_LIDAR_BIAS: the same, as shifts"),
    "borders": Nuisance(EDGE, "BORDER_SHARE x scatter of the pulls of sides, ranges and halves of the image"),
    "along_paint": Nuisance(EDGE, "gradients along lines, which only run ahead"),
    "travel": Nuisance(EDGE, "CAMERA_LIDAR_DT_FLOOR_S x way driven in it"),
    "traffic": Nuisance(EDGE, "the time offset, and the pose with it, without either half of the image"),
}


@dataclass(frozen=True, eq=False)
class Considered:
    """By how much an error may have moved a solution, one row for each independent part of it.

    Args:
        name: of NUISANCES.
        rows: one sigma each, of the solution's unknowns [rad, m, s].
    """

    name: str
    rows: Float[np.ndarray, "K P"]

    def __post_init__(self) -> None:
        assert self.name in NUISANCES, self.name


def considered_covariance(errors: Iterable[Considered]) -> Float[np.ndarray, "P P"]:
    """Sum of their covariances: they are independent of each other."""
    rows = np.vstack([error.rows for error in errors])
    return rows.T @ rows


def by_owner(errors: Iterable[Considered]) -> dict[str, Float[np.ndarray, "6 6"]]:
    """Covariance of the pose by owner."""
    errors = list(errors)
    owners = dict.fromkeys(NUISANCES[error.name].owner for error in errors)
    return {
        owner: considered_covariance(e for e in errors if NUISANCES[e.name].owner == owner)[:6, :6]
        for owner in owners
    }


def considered_numbers(errors: Iterable[Considered]) -> dict[str, float]:
    """Sigma of the parent's pitch and yaw by each error, for the record [deg]."""
    return {
        f"{error.name}_{axis}_deg": float(np.degrees(np.linalg.norm(error.rows[:, k])))
        for error in errors
        for k, axis in enumerate(("pitch", "yaw"))
    }

"""Errors that all frames of a day share and none shows: considered in a solution's covariance, not solved for.

Each is stated by how far it may have moved the solution (`Considered.rows`), and one formula adds all of them. They
are common to all days of a vehicle: its masks, borders and roads stay. NUISANCES has one row for each.

Source: Schmidt 1966 (considered parameters).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from pipeline.rig.evidence import EDGE
from pipeline.rig.graph import Edge

__all__ = [
    "NUISANCES",
    "Considered",
    "Nuisance",
    "by_sensor",
    "considered_covariance",
    "considered_numbers",
    "estimate_biases",
    "root_rows",
]


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
    # camera-lidar
    "masks": Nuisance("camera", "CAMERA_LIDAR_BIAS: dilation of masks, focal length, rolling shutter"),
    "positions": Nuisance(EDGE, "CAMERA_LIDAR_BIAS: the same, as shifts"),
    "borders": Nuisance(EDGE, "BORDER_SHARE x scatter of the pulls of sides, ranges and halves of the image"),
    "along_paint": Nuisance(EDGE, "gradients along lines, which only run ahead"),
    "travel": Nuisance(EDGE, "CAMERA_LIDAR_DT_FLOOR_S x distance driven in it"),
    "traffic": Nuisance(EDGE, "the time offset, and the pose with it, without either half of the image"),
    "optical_axis": Nuisance(
        EDGE, "what edges and markings err by alike in tz: `profiles`, TZ_COMMON_BIAS_M"
    ),
    # lidar-radar
    "surfaces": Nuisance(EDGE, "LIDAR_RADAR_BIAS: radars see into objects, unobserved roll tilts azimuths"),
    "clock": Nuisance(
        EDGE, "LIDAR_RADAR_DT_FLOOR_S, and ten more steps of the time offset in its flat valley"
    ),
    "elevations": Nuisance(
        EDGE, "ElevationSpread, DOPPLER_PITCH_FLOOR_RAD, Heights.floor_rad: sources of pitch"
    ),
    "seen_low": Nuisance(EDGE, "SeenLow, TravelDirections.bias_rad: detections measured too low"),
    # camera-radar
    "boxes": Nuisance("radar", "CAMERA_RADAR_BIAS: how a radar sees cars, whichever camera has their boxes"),
    # lidar-lidar and edges to the vehicle frame
    "matching": Nuisance(EDGE, "floors of `edges/`: between halves and days of vehicles that did not change"),
    "stance": Nuisance("base", "edges.on_base.STANCE: load, springs and toe"),
    "beams": Nuisance(EDGE, "edges.lidar_base: elevations of beams, where the road alone shows a tilt"),
    "ranges": Nuisance("lidar", "edges.lidar_base: ranges of the road"),
    "centre": Nuisance("camera", "edges.camera_base: principal point"),
    "aside": Nuisance(EDGE, "edges.camera_base: distortion and turn of a camera that does not look ahead"),
}


@dataclass(frozen=True, eq=False)
class Considered:
    """By how much an error may have moved a solution, one row for each independent part of it.

    Args:
        name: of NUISANCES.
        rows: one sigma each, of the solution's unknowns [rad, m, s].
        in_weights: the weights of the data count it already: it is part of the solution's scatter.
    """

    name: str
    rows: Float[np.ndarray, "K P"]
    in_weights: bool = False

    def __post_init__(self) -> None:
        assert self.name in NUISANCES, self.name

    @property
    def owner(self) -> str:
        """Kind of the sensor that brings it, or EDGE."""
        return NUISANCES[self.name].owner

    def of_pose(self, J: Float[np.ndarray, "6 6"]) -> Considered:
        """The same of a pose; J is its derivative by the first six unknowns."""
        return replace(self, rows=self.rows[:, :6] @ J.T)


def considered_covariance(errors: Iterable[Considered]) -> Float[np.ndarray, "P P"]:
    """Sum of their covariances: they are independent of each other."""
    rows = np.vstack([error.rows for error in errors])
    return rows.T @ rows


def estimate_biases(errors: Iterable[Considered], to_left: Float[np.ndarray, "6 6"]) -> dict[str, Any]:
    """`bias` and `bias_in_weights` of a `PairEstimate`.

    Args:
        to_left: derivative of the pose's left perturbation by the first six unknowns.
    """
    moved = [error.of_pose(to_left) for error in errors]
    within = [error for error in moved if error.in_weights]
    return {
        "bias": _by_owner(error for error in moved if not error.in_weights),
        "bias_in_weights": considered_covariance(within) if within else None,
    }


def by_sensor(errors: Iterable[Considered], edge: Edge) -> Mapping[str, Float[np.ndarray, "6 6"]]:
    """`bias` of an `EdgeEvidence`; the rows of each error are in axes of its owner."""
    names: dict[str, str] = {sensor.kind: sensor.name for sensor in edge.sensors}
    return {names.get(owner, owner): C for owner, C in _by_owner(errors).items()}


def _by_owner(errors: Iterable[Considered]) -> dict[str, Float[np.ndarray, "6 6"]]:
    errors = list(errors)
    owners = dict.fromkeys(error.owner for error in errors)
    return {owner: considered_covariance(e for e in errors if e.owner == owner) for owner in owners}


def root_rows(covariance: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P P"]:
    """Rows of a covariance, one for each principal axis."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0.0))).T


def considered_numbers(errors: Iterable[Considered], *, of_camera: bool) -> dict[str, float]:
    """Sigma of the parent's pitch and yaw by each error, for the record [deg]; the parent is a camera or a lidar."""
    axes = {"pitch": 0, "yaw": 1} if of_camera else {"pitch": 1, "yaw": 2}
    return {
        f"{error.name}_{axis}_deg": float(np.degrees(np.linalg.norm(error.rows[:, k])))
        for error in errors
        for axis, k in axes.items()
    }

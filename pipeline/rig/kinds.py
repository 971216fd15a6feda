"""Kinds of edges, one row each: all that other rooms need to know of a kind beside its estimator.

A new kind is a row here, a file in `calibrate/edges` that `solver` names, and what perception it reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Bool

from schemas.calibrations import DOF_NAMES

__all__ = ["EDGE_KINDS", "KIND_OF_EDGE", "EdgeKind"]

_BOTH: Final = ("azimuth", "elevation")


@dataclass(frozen=True)
class EdgeKind:
    """What a kind of edge is good for, and how it is judged and watched.

    Args:
        name: kinds of parent and child; column `pair` of records.
        order: place among the edges of a day, which use the results of earlier ones: lidars and radars on the base show
            the direction of travel, which camera-lidar needs.
        solver: import path of `(edge, DaySources) -> (EdgeEvidence, frames)`; empty for pairs of a camera, a lidar and
            a radar, which a method of calibration estimates.
        needed: directions that it is to certify.
        needs_all: all of `needed`; else one of them is worth accepting. A radar without elevation is still worth its
            azimuth.
        scored: degrees of freedom that its held-out score depends on; empty = it has none. Registration and boxes do
            not see a radar's elevation.
        tilts: degrees of freedom that make up a radar's elevation.
        probed: axes about which held-out frames are compared at known turns.
        watched: turns that every night determines: what a GREEN chart of it excludes. Of cameras pitch and yaw, the
            image's two axes; of radars yaw alone: they measure azimuth ten times better than elevation.
        watches: by kind of sensor that its charts watch, the rank: those of a higher rank only where it has none of a
            lower.
        has_tilt: both of its sensors see all rotations about as well.
    """

    name: str
    order: int
    solver: str = ""
    needed: tuple[str, ...] = _BOTH
    needs_all: bool = False
    scored: tuple[str, ...] = ()
    tilts: tuple[str, ...] = ()
    probed: tuple[str, ...] = ()
    watched: tuple[str, ...] = ()
    watches: Mapping[str, int] = field(default_factory=dict)
    has_tilt: bool = False

    @property
    def is_scored(self) -> Bool[np.ndarray, " 6"]:
        """Which degrees of freedom its held-out score depends on."""
        return np.isin(DOF_NAMES, self.scored)

    @property
    def required(self) -> tuple[str, ...] | None:
        """Directions without which there is nothing to accept; None = either is enough."""
        return self.needed if self.needs_all else None


_EDGES: Final = "pipeline.calibrate.edges"
KIND_OF_EDGE: Final[Mapping[str, EdgeKind]] = {
    kind.name: kind
    for kind in (
        EdgeKind(
            "camera_lidar", 4, needs_all=True, scored=DOF_NAMES, probed=(*_BOTH, "roll"),
            watched=("rx", "ry"), watches={"camera": 0, "lidar": 0}, has_tilt=True,
        ),
        EdgeKind(
            "camera_radar", 5, needed=("azimuth",), needs_all=True, scored=("ry",), tilts=("rx", "rz"),
            watched=("ry",), watches={"camera": 1, "radar": 0},
        ),
        EdgeKind(
            "lidar_radar", 3, needed=("azimuth",), needs_all=True, scored=("rz", "tx", "ty"), tilts=("rx", "ry", "tz"),
            probed=("azimuth",), watched=("rz",), watches={"lidar": 1, "radar": 0},
        ),
        EdgeKind(
            "lidar_lidar", 2, f"{_EDGES}.lidar_lidar:solve", scored=DOF_NAMES,
            watched=("rx", "ry", "rz"), watches={"lidar": 0}, has_tilt=True,
        ),
        EdgeKind("lidar_base", 0, f"{_EDGES}.lidar_base:solve", watched=("rx", "ry"), watches={"lidar": 2}),
        EdgeKind(
            "radar_base", 1, f"{_EDGES}.radar_base:solve", needed=("azimuth",), watched=("rz",), watches={"radar": 1}
        ),
        EdgeKind("camera_base", 1, f"{_EDGES}.camera_base:solve", watched=("rx", "ry"), watches={"camera": 2}),
    )
}  # fmt: skip
# Two cameras are connected through a lidar or the base.
EDGE_KINDS: Final = tuple(KIND_OF_EDGE)

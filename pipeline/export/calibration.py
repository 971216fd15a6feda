"""What every format is written from, and what reading one gives back."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from pipeline.errors import ConfigError
from pipeline.geometry.cameras import Camera
from pipeline.geometry.changes import change_between, change_covariance, change_jacobian
from pipeline.geometry.se3 import adjoint, exp_so3, from_rotation_translation, inverse
from schemas.calibrations import DOF_NAMES

__all__ = [
    "USABLE",
    "Edge",
    "ExportedCalibration",
    "ExportedPair",
    "FrameNames",
    "edges_of",
    "is_frame",
    "needed_camera",
    "needed_pair",
    "sigmas_of",
]

# Statuses of a pair that may be loaded: of a record, and of a vehicle's state.
USABLE = ("accepted", "current")
# Of a ROS frame; also what needs no quoting in XML, YAML, a shell or a xacro expression.
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_./-]*")


def is_frame(name: str) -> bool:
    """True for a name that a frame can have in every format."""
    return _FRAME.fullmatch(name) is not None


@dataclass(frozen=True)
class FrameNames:
    """What the sensors' frames are called where the file goes; `base` is used where its pose is known."""

    camera: str = "camera"
    lidar: str = "lidar"
    radar: str = "radar"
    base: str = "base_link"

    def __post_init__(self) -> None:
        values = {"camera": self.camera, "lidar": self.lidar, "radar": self.radar, "base": self.base}
        for option, name in values.items():
            if not is_frame(name):
                problem = f"{name!r} is no frame name: letters, digits and _ - . / only, no / in front"
                raise ConfigError("command line", f"{option}-frame", problem)
        if len(set(values.values())) < len(values):
            raise ConfigError("command line", "frame names", f"must differ: {', '.join(values.values())}")

    def of(self, sensor: str) -> str:
        """Name of the frame of camera, lidar or radar."""
        return {"camera": self.camera, "lidar": self.lidar, "radar": self.radar}[sensor]


@dataclass(frozen=True, eq=False)
class ExportedPair:
    """One pair: T_parent_child, how sure it is, and where it comes from.

    Args:
        pair: camera_lidar, camera_radar or lidar_radar.
        T: T_parent_child.
        covariance: 6x6 of the left perturbation, rx ry rz tx ty tz in parent axes [rad, m]; None where nobody says.
        status: of the record or state.
        reason: in words.
        observable: per DoF, whether the data determined it; the others keep the prior.
        certified: of azimuth and elevation, those within their limit.
        common: the part of the covariance that all days of a vehicle err by alike; None where nobody says.
        details: what else is known of its origin, in plain values (work key, days, time offset, notes).
        unchecked: by DoF, how many sigmas it lies from the prior where that is far and nothing checks it.
        resting: those of `unchecked` that were put back to the prior.
    """

    pair: str
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"] | None = None
    status: str = "accepted"
    reason: str = ""
    observable: tuple[bool, ...] = (True,) * 6
    certified: tuple[str, ...] = ("azimuth", "elevation")
    common: Float[np.ndarray, "6 6"] | None = None
    details: Mapping[str, object] = field(default_factory=dict)
    unchecked: Mapping[str, float] = field(default_factory=dict)
    resting: tuple[str, ...] = ()

    @property
    def at_prior(self) -> list[str]:
        """Degrees of freedom that the data did not determine."""
        return [name for name, seen in zip(DOF_NAMES, self.observable, strict=True) if not seen]

    def resting_at(
        self, T_prior: Float[np.ndarray, "4 4"], prior_covariance: Float[np.ndarray, "6 6"]
    ) -> ExportedPair:
        """The pair with what nothing checks back at the prior, as unsure as that; the others follow as they covary."""
        rows = [DOF_NAMES.index(dof) for dof in self.unchecked]
        if not rows or self.covariance is None:
            return self
        J = change_jacobian(self.T)
        C, P = J @ self.covariance @ J.T, change_covariance(T_prior, prior_covariance)
        gain = C[:, rows] @ np.linalg.inv(C[np.ix_(rows, rows)])
        change = change_between(T_prior, self.T)
        change = change - gain @ change[rows]
        C = C + gain @ (P - C)[np.ix_(rows, rows)] @ gain.T
        T = from_rotation_translation(exp_so3(change[:3]) @ T_prior[:3, :3], T_prior[:3, 3] + change[3:])
        K = np.linalg.inv(change_jacobian(T))
        return replace(self, T=T, covariance=K @ C @ K.T, resting=tuple(self.unchecked))


@dataclass(frozen=True, eq=False)
class ExportedCalibration:
    """A calibration on its way into a file.

    Args:
        vehicle: its id.
        source: in words, as "record of 2026-03-02".
        method: of the calibration.
        code_version: of Boresight.
        pairs: by pair; camera_lidar and lidar_radar are what a file holds, camera_radar only says how sure it is.
        camera: intrinsics, where known.
        names: of the frames.
        T_base_lidar: where the lidar sits on the car; None: the lidar is the root of the tree.
        left_out: pair to reason, of those that are not in `pairs`.
        word: of the record or state as a whole, one of DAY_WORDS.
    """

    vehicle: str
    source: str
    method: str
    code_version: str
    pairs: Mapping[str, ExportedPair]
    camera: Camera | None = None
    names: FrameNames = field(default_factory=FrameNames)
    T_base_lidar: Float[np.ndarray, "4 4"] | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    word: str = "done"

    @property
    def root(self) -> str:
        """Name of the frame that all others hang on."""
        return self.names.lidar if self.T_base_lidar is None else self.names.base

    def T_root(self, sensor: str) -> Float[np.ndarray, "4 4"] | None:
        """T_root_sensor of camera, lidar or radar; None where the calibration lacks it."""
        T_root_lidar = np.eye(4) if self.T_base_lidar is None else self.T_base_lidar
        found = {edge.sensor: edge.T for edge in edges_of(self) if edge.sensor != "lidar"}
        if sensor == "lidar":
            return T_root_lidar
        return T_root_lidar @ found[sensor] if sensor in found else None


@dataclass(frozen=True, eq=False)
class Edge:
    """A sensor's pose: T takes coordinates in `child` to `parent`; the covariance is in parent axes."""

    sensor: str
    parent: str
    child: str
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"] | None = None


def edges_of(calibration: ExportedCalibration) -> list[Edge]:
    """The tree of frames, parents first: base -> lidar where known, lidar -> camera, lidar -> radar."""
    names, pairs = calibration.names, calibration.pairs
    edges = []
    if calibration.T_base_lidar is not None:
        edges.append(Edge("lidar", names.base, names.lidar, calibration.T_base_lidar))
    if "camera_lidar" in pairs:
        pair = pairs["camera_lidar"]
        T = inverse(pair.T)
        A = adjoint(T)
        covariance = None if pair.covariance is None else A @ pair.covariance @ A.T
        edges.append(Edge("camera", names.lidar, names.camera, T, covariance))
    if "lidar_radar" in pairs:
        pair = pairs["lidar_radar"]
        edges.append(Edge("radar", names.lidar, names.radar, pair.T, pair.covariance))
    return edges


def sigmas_of(
    T: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"] | None
) -> dict[str, float] | None:
    """Sigmas of the rotation about the parent's axes [rad] and of the child's origin [m], by name."""
    if covariance is None:
        return None
    sigma = np.sqrt(np.diag(change_covariance(T, covariance)))
    units = ["rad"] * 3 + ["m"] * 3
    return {f"{dof}_{unit}": float(s) for dof, unit, s in zip(DOF_NAMES, units, sigma, strict=True)}


def needed_pair(calibration: ExportedCalibration, pair: str, by: str) -> ExportedPair:
    """A pair that a format cannot do without.

    Raises:
        ConfigError: it is left out.
    """
    if pair not in calibration.pairs:
        reason = calibration.left_out.get(pair, "there is no record of it")
        raise ConfigError(f"export {by}", pair, f"the format needs it: {reason}")
    return calibration.pairs[pair]


def needed_camera(calibration: ExportedCalibration, by: str) -> Camera:
    """The camera's intrinsics, for a format that cannot do without.

    Raises:
        ConfigError: they are not known.
    """
    if calibration.camera is None:
        problem = "the format needs intrinsics, and the lake has no observations of these days any more"
        raise ConfigError(f"export {by}", "camera", problem)
    return calibration.camera

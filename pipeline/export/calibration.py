"""The calibration that every format is written from, and its poses."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import ConfigError
from pipeline.rig.cameras import Camera
from pipeline.rig.graph import BASE, KINDS, Edge, RigGraph, Sensor, words_of
from pipeline.rig.se3 import adjoint, change_covariance, inverse
from schemas.calibrations import DOF_NAMES

__all__ = [
    "USABLE",
    "ExportedCalibration",
    "ExportedPair",
    "FrameNames",
    "Pose",
    "cameras_of",
    "is_frame",
    "needed_camera",
    "poses_of",
    "reference_of",
    "replaced_transforms",
    "sigmas_of",
    "written_pairs",
]

# Statuses of a pair that may be loaded, of records and of states.
USABLE = ("accepted", "current", "prior")
_KINDS = ("camera", "lidar", "radar", "base")
_BASE_LINK = "base_link"  # frame of base, if no other name is given
_REFERENCES = ("lidar", "radar", "camera")  # sensor kinds in order of preference as reference of the poses
# Valid as a ROS frame, and without quotes in XML, YAML, a shell and a xacro expression.
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_./-]*")


def is_frame(name: str) -> bool:
    """Whether a name is valid for a frame in every format."""
    return _FRAME.fullmatch(name) is not None


@dataclass(frozen=True)
class FrameNames:
    """Frame names by sensor in the exported file; other sensors keep their names. ConfigError if they are invalid."""

    frames: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for option, name in self.frames.items():
            if not is_frame(name):
                problem = (
                    f"{name!r} is not a valid frame name: letters, digits and _ - . / only, no / in front"
                )
                raise ConfigError("command line", f"{option}-frame", problem)
        # In a rig whose sensors have other names, the names of three sensors apply to none.
        require_different([self.of(s) for s in [s for s in self.frames if s not in _KINDS] or _KINDS])

    def of(self, sensor: str) -> str:
        """Frame name of a sensor or of base."""
        return self.frames.get(sensor, _BASE_LINK if sensor == BASE.name else sensor)


def require_different(names: Sequence[str]) -> None:
    """Raise ConfigError if two frames have the same name."""
    if len(set(names)) < len(names):
        raise ConfigError("command line", "frame names", f"must differ: {', '.join(names)}")


@dataclass(frozen=True, eq=False)
class ExportedPair:
    """One edge: T_parent_child, its uncertainty and its origin.

    Args:
        covariance: 6x6 of the left perturbation, rx ry rz tx ty tz in parent axes [rad, m]; None if unknown.
        observable: per DoF, whether the data determined it; the other DoF keep the prior.
        certified: whether azimuth and elevation are within their limits.
        common: part of the covariance that is common to all days of a vehicle; None if unknown.
        details: more about its origin, in plain values (work key, days, time offset, notes).
    """

    edge: Edge
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"] | None = None
    status: str = "accepted"
    reason: str = ""
    observable: tuple[bool, ...] = (True,) * 6
    certified: tuple[str, ...] = ("azimuth", "elevation")
    common: Float[np.ndarray, "6 6"] | None = None
    details: Mapping[str, object] = field(default_factory=dict)

    @property
    def pair(self) -> str:
        """Name of the edge: camera_lidar, camera_radar, lidar_radar, or sensor names such as front-top."""
        return words_of(self.edge)

    @property
    def identifier(self) -> str:
        """Both sensor names as one identifier that is valid in every language, as in T_front_top."""
        return f"{self.edge.parent.name}_{self.edge.child.name}"

    @property
    def at_prior(self) -> list[str]:
        """Degrees of freedom that the data did not determine."""
        return [name for name, seen in zip(DOF_NAMES, self.observable, strict=True) if not seen]


def reference_of(edges: Collection[Edge]) -> Sensor:
    """Reference sensor of the poses: the lidar with most edges; without a lidar, the radar."""
    ends = Counter(sensor for edge in edges for sensor in edge.sensors if sensor != BASE)
    return min(ends, key=lambda s: (_REFERENCES.index(s.kind), -ends[s], s.name))


@dataclass(frozen=True, eq=False)
class ExportedCalibration:
    """A calibration to be exported.

    Args:
        pairs: edges by name. A file holds poses relative to the reference along edges with a lidar. An edge
            of camera and radar contributes its sigma only, unless no other edge connects them.
        T_base_lidar: pose of the reference on the car; None = from an edge to base, or the reference is the
            root.
        left_out: reason by name, for edges that are not in `pairs`.
        word: status of the record or state as a whole, one of DAY_WORDS.
        edges: all edges of the vehicle, those left out included, in order.
        own_tree: parent of each frame above the sensors in the car's own /tf_static.
    """

    vehicle: str
    source: str
    method: str
    code_version: str
    pairs: Mapping[str, ExportedPair]
    edges: tuple[Edge, ...]
    names: FrameNames = field(default_factory=FrameNames)
    T_base_lidar: Float[np.ndarray, "4 4"] | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    word: str = "done"
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    own_tree: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_different([self.names.of(sensor.name) for sensor in (*self.sensors, BASE)])

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """All sensors of its edges: cameras, lidars, radars."""
        found = {sensor for edge in self.edges for sensor in edge.sensors if sensor != BASE}
        return tuple(sorted(found, key=lambda s: (KINDS.index(s.kind), s.name)))

    @property
    def reference(self) -> Sensor:
        """Reference of the poses: the lidar with most edges; without a lidar, the radar."""
        return reference_of(self.edges)

    @property
    def root(self) -> str:
        """Name of the root frame."""
        return self.names.of(self.reference.name if self.T_base is None else BASE.name)

    @property
    def T_base(self) -> Float[np.ndarray, "4 4"] | None:
        """T_base_reference, as given or from an edge to base; None if unknown."""
        return None if (found := self.on_base()) is None else found[0]

    def on_base(self) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"] | None] | None:
        """T_base and its covariance, None for one that is given; None if unknown."""
        given = self.T_base_lidar
        return self.between(BASE.name, self.reference.name) if given is None else (given, None)

    def T_root(self, sensor: str) -> Float[np.ndarray, "4 4"] | None:
        """T_root_sensor; None if the calibration does not have it."""
        T, T_base = self.T_between(self.reference.name, sensor), self.T_base
        return T if T is None or T_base is None else T_base @ T

    def way(self, a: str, b: str) -> tuple[Edge, ...] | None:
        """Chain of edges from one sensor to another, with or without estimates; None if not connected."""
        nodes = {s.name: s for edge in self.edges for s in edge.sensors}
        if a not in nodes or b not in nodes:
            return None
        graph = RigGraph(tuple(nodes.values()), self.edges, nodes[a])
        sure = graph.without([edge for edge in self.edges if edge.kind == "camera_radar"])
        way = sure.path(nodes[a], nodes[b])
        return graph.path(nodes[a], nodes[b]) if way is None else way

    def T_between(self, a: str, b: str) -> Float[np.ndarray, "4 4"] | None:
        """T_a_b; None if there is no estimate."""
        found = self.between(a, b)
        return None if found is None else found[0]

    def between(
        self, a: str, b: str
    ) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"] | None] | None:
        """T_a_b and its covariance in axes of a (None if unknown); None if there is no estimate."""
        pairs, way = {pair.edge: pair for pair in self.pairs.values()}, self.way(a, b)
        if way is None or any(edge not in pairs for edge in way):
            return None
        T, covariance, here = np.eye(4), np.zeros((6, 6)), a
        for edge in way:
            step, C = pairs[edge].T, pairs[edge].covariance
            C = np.full((6, 6), np.nan) if C is None else C
            if edge.parent.name != here:
                step = inverse(step)
                C = adjoint(step) @ C @ adjoint(step).T
            covariance = covariance + adjoint(T) @ C @ adjoint(T).T
            T, here = T @ step, edge.other(here).name
        return T, None if np.isnan(covariance).any() else covariance


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of a sensor: T maps from frame `child` to frame `parent`, whose axes the covariance has."""

    sensor: str
    parent: str
    child: str
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"] | None = None


def poses_of(calibration: ExportedCalibration) -> list[Pose]:
    """Tree of poses, parents first: base -> reference if known, then reference -> each other sensor."""
    names, reference = calibration.names, calibration.reference.name
    poses, on_base = [], calibration.on_base()
    if on_base is not None:
        poses.append(Pose(reference, names.of(BASE.name), names.of(reference), *on_base))
    for sensor in calibration.sensors:
        found = None if sensor.name == reference else calibration.between(reference, sensor.name)
        if found is not None:
            poses.append(Pose(sensor.name, names.of(reference), names.of(sensor.name), *found))
    return poses


def replaced_transforms(calibration: ExportedCalibration) -> list[str]:
    """Transforms of the car's own /tf_static that the poses replace, as `parent -> child`.

    A frame has one parent, and no chain of frames returns to itself: with both sources on, one of them is ignored.
    """
    children = {pose.child for pose in poses_of(calibration)}
    own, above = calibration.own_tree, calibration.root
    passed = {above}
    while own.get(above, above) not in passed:
        above = own[above]
        passed.add(above)
    # Where the root has one of these children above it, the chain is cut at the root.
    replaced = {f for f in own if f in children} | ({calibration.root} if passed & children else set())
    return [f"{own[child]} -> {child}" for child in sorted(replaced)]


def written_pairs(calibration: ExportedCalibration) -> list[str]:
    """Names of the edges that the poses are made of, in order."""
    reference = calibration.reference.name
    used = {edge for s in calibration.sensors for edge in calibration.way(reference, s.name) or ()}
    return [name for name, pair in calibration.pairs.items() if pair.edge in used]


def sigmas_of(
    T: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"] | None
) -> dict[str, float] | None:
    """Sigmas of the rotation about the parent's axes [rad] and of the child's origin [m], by name."""
    if covariance is None:
        return None
    sigma = np.sqrt(np.diag(change_covariance(T, covariance)))
    units = ["rad"] * 3 + ["m"] * 3
    return {f"{dof}_{unit}": float(s) for dof, unit, s in zip(DOF_NAMES, units, sigma, strict=True)}


def cameras_of(calibration: ExportedCalibration, by: str) -> list[str]:
    """Cameras with a known pose; raises ConfigError, with the reason for a camera left out, if none."""
    reference = calibration.reference.name
    cameras = [s.name for s in calibration.sensors if s.kind == "camera"]
    found = [name for name in cameras if calibration.T_between(reference, name) is not None]
    if found:
        return found
    lacking = {words_of(edge) for name in cameras for edge in calibration.way(reference, name) or ()}
    reasons = {words: why for words, why in calibration.left_out.items() if words in lacking}
    pair, reason = next(iter(reasons.items()), ("camera_lidar", "there is no record of it"))
    raise ConfigError(f"export {by}", pair, f"the format needs it: {reason}")


def needed_camera(calibration: ExportedCalibration, by: str, sensor: str) -> Camera:
    """Intrinsics of a camera, for formats that require them; raises ConfigError if unknown."""
    if sensor not in calibration.cameras:
        problem = "the format needs intrinsics, and the observations of these days are no longer in the lake"
        raise ConfigError(f"export {by}", sensor, problem)
    return calibration.cameras[sensor]

"""What every format is written from, and what reading one gives back."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from pipeline.errors import ConfigError
from pipeline.geometry.cameras import Camera
from pipeline.geometry.changes import change_between, change_covariance, change_jacobian, changed
from pipeline.geometry.se3 import adjoint, inverse
from pipeline.rig.edges import EDGE_OF_PAIR, edge_order, words_of
from pipeline.rig.graph import BASE, KINDS, Edge, RigGraph, Sensor
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
    "sigmas_of",
    "written_pairs",
]

# Statuses of a pair that may be loaded: of a record, and of a vehicle's state.
USABLE = ("accepted", "current")
_KINDS = ("camera", "lidar", "radar", "base")
_REFERENCES = ("lidar", "radar", "camera")  # kinds that poses refer to, the first that there is
# Of a ROS frame; also what needs no quoting in XML, YAML, a shell or a xacro expression.
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_./-]*")


def is_frame(name: str) -> bool:
    """True for a name that a frame can have in every format."""
    return _FRAME.fullmatch(name) is not None


@dataclass(frozen=True)
class FrameNames:
    """What the sensors' frames are called where the file goes; `base` is used where its pose is known.

    Args:
        camera, lidar, radar, base: of sensors of these names.
        others: by name of any other sensor; one that no name is given is called as itself.
    """

    camera: str = "camera"
    lidar: str = "lidar"
    radar: str = "radar"
    base: str = "base_link"
    others: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        values = {sensor: self.of(sensor) for sensor in (*_KINDS, *self.others)}
        for option, name in values.items():
            if not is_frame(name):
                problem = f"{name!r} is no frame name: letters, digits and _ - . / only, no / in front"
                raise ConfigError("command line", f"{option}-frame", problem)
        # A rig whose sensors have names of their own has none that the defaults are for.
        require_different([values[sensor] for sensor in self.others or _KINDS])

    @classmethod
    def named(cls, frames: Mapping[str, str]) -> FrameNames:
        """Names by sensor.

        Raises:
            ConfigError: no names of frames.
        """
        known = {sensor: name for sensor, name in frames.items() if sensor in _KINDS}
        return cls(**known, others={s: n for s, n in frames.items() if s not in _KINDS})

    def of(self, sensor: str) -> str:
        """Name of the frame of a sensor, or of base."""
        known = {"camera": self.camera, "lidar": self.lidar, "radar": self.radar, "base": self.base}
        return {**known, **self.others}.get(sensor, sensor)


def require_different(names: Sequence[str]) -> None:
    """Raise ConfigError for two frames of one name."""
    if len(set(names)) < len(names):
        raise ConfigError("command line", "frame names", f"must differ: {', '.join(names)}")


@dataclass(frozen=True, eq=False)
class ExportedPair:
    """One edge: T_parent_child, how sure it is, and where it comes from.

    Args:
        pair: the edge in words: camera_lidar, camera_radar, lidar_radar, or names of sensors, as front-top.
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
        of: the edge; None = the one that its words say.
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
    of: Edge | None = None

    @property
    def edge(self) -> Edge:
        """The edge; of three sensors that are called by their kinds where it is not given."""
        return EDGE_OF_PAIR[self.pair] if self.of is None else self.of

    @property
    def identifier(self) -> str:
        """Names of both sensors as one word that every language takes for a name, as in T_front_top."""
        return f"{self.edge.parent.name}_{self.edge.child.name}"

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
        T = changed(T_prior, change)
        K = np.linalg.inv(change_jacobian(T))
        return replace(self, T=T, covariance=K @ C @ K.T, resting=tuple(self.unchecked))


def reference_of(edges: Collection[Edge]) -> Sensor:
    """The sensor that poses refer to: the lidar with most edges, of a vehicle without a lidar the radar."""
    ends = Counter(sensor for edge in edges for sensor in edge.sensors if sensor != BASE)
    return min(ends, key=lambda s: (_REFERENCES.index(s.kind), -ends[s], s.name))


@dataclass(frozen=True, eq=False)
class ExportedCalibration:
    """A calibration on its way into a file.

    Args:
        vehicle: its id.
        source: in words, as "record of 2026-03-02".
        method: of the calibration.
        code_version: of Boresight.
        pairs: edges by their words. A file holds poses to the reference along edges with a lidar; camera and radar
            against each other say only how sure they are, unless nothing else ties them.
        camera: intrinsics of the only camera, where known.
        names: of the frames.
        T_base_lidar: where the reference sits on the car; None: an edge to base says it, or the reference is the root.
        left_out: words of an edge to reason, of those that are not in `pairs`.
        word: of the record or state as a whole, one of DAY_WORDS.
        cameras: intrinsics of each camera by name, where there are several.
        known: all edges of the vehicle, with those that are left out; empty: those of camera, lidar and radar.
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
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    known: tuple[Edge, ...] = ()

    def __post_init__(self) -> None:
        require_different([self.names.of(sensor.name) for sensor in (*self.sensors, BASE)])

    @property
    def edges(self) -> tuple[Edge, ...]:
        """All edges of the vehicle, in order."""
        return tuple(sorted(set(self.known or EDGE_OF_PAIR.values()), key=edge_order))

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """All sensors of its edges: cameras, lidars, radars."""
        found = {sensor for edge in self.edges for sensor in edge.sensors if sensor != BASE}
        return tuple(sorted(found, key=lambda s: (KINDS.index(s.kind), s.name)))

    @property
    def reference(self) -> Sensor:
        """What poses refer to: the lidar with most edges, of a vehicle without one the radar."""
        return reference_of(self.edges)

    @property
    def root(self) -> str:
        """Name of the frame that all others hang on."""
        return self.names.of(self.reference.name) if self.T_base is None else self.names.base

    @property
    def T_base(self) -> Float[np.ndarray, "4 4"] | None:
        """T_base_reference: as given, or by an edge to base; None where nobody knows."""
        if self.T_base_lidar is not None:
            return self.T_base_lidar
        found = self.between(BASE.name, self.reference.name) if self._has(BASE.name) else None
        return None if found is None else found[0]

    def camera_of(self, sensor: str) -> Camera | None:
        """A camera's intrinsics; None where they are not known."""
        only = [s.name for s in self.sensors if s.kind == "camera"] == [sensor]
        return self.cameras.get(sensor, self.camera if only else None)

    def T_root(self, sensor: str) -> Float[np.ndarray, "4 4"] | None:
        """T_root_sensor; None where the calibration lacks it."""
        found = self.between(self.reference.name, sensor)
        if found is None:
            return None
        T_base = self.T_base
        return found[0] if T_base is None else T_base @ found[0]

    def way(self, a: str, b: str) -> tuple[Edge, ...] | None:
        """Edges that lead from one sensor to another; None where none do. They need not have an estimate."""
        nodes = {s.name: s for edge in self.edges for s in edge.sensors}
        if a not in nodes or b not in nodes:
            return () if a == b else None
        graph = RigGraph(tuple(nodes.values()), self.edges, nodes[a])
        sure = graph.without([edge for edge in self.edges if edge.kind == "camera_radar"])
        way = sure.path(nodes[a], nodes[b])
        return graph.path(nodes[a], nodes[b]) if way is None else way

    def between(
        self, a: str, b: str
    ) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"] | None] | None:
        """T_a_b and its covariance in a's axes (None: nobody says); None where the calibration lacks it."""
        pairs, way = {pair.edge: pair for pair in self.pairs.values()}, self.way(a, b)
        if way is None or any(edge not in pairs for edge in way):
            return None
        T, covariance, here = np.eye(4), None, a
        for k, edge in enumerate(way):
            step, sure = _step(pairs[edge], here)
            A = adjoint(T)
            covariance = sure if k == 0 else _sum(covariance, None if sure is None else A @ sure @ A.T)
            T, here = step if k == 0 else T @ step, edge.other(here).name
        return T, covariance

    def _has(self, node: str) -> bool:
        return any(node in (s.name for s in edge.sensors) for edge in self.edges)


@dataclass(frozen=True, eq=False)
class Pose:
    """A sensor's pose: T takes coordinates in `child` to `parent`, names of frames; covariance in parent axes."""

    sensor: str
    parent: str
    child: str
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"] | None = None


def poses_of(calibration: ExportedCalibration) -> list[Pose]:
    """The tree of frames, parents first: base -> reference where known, reference -> each other sensor."""
    names, reference = calibration.names, calibration.reference.name
    poses, T_base = [], calibration.T_base
    if T_base is not None:
        poses.append(Pose(reference, names.base, names.of(reference), T_base))
    for sensor in calibration.sensors:
        found = None if sensor.name == reference else calibration.between(reference, sensor.name)
        if found is not None:
            poses.append(Pose(sensor.name, names.of(reference), names.of(sensor.name), *found))
    return poses


def written_pairs(calibration: ExportedCalibration) -> list[str]:
    """Words of the edges that poses are made of, in order."""
    reference = calibration.reference.name
    used = {edge for s in calibration.sensors for edge in calibration.way(reference, s.name) or ()}
    return [name for name, pair in calibration.pairs.items() if pair.edge in used]


def _step(pair: ExportedPair, here: str) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"] | None]:
    """An edge's transform from the sensor where one stands, and its covariance in that sensor's axes."""
    if pair.edge.parent.name == here:
        return pair.T, pair.covariance
    T = inverse(pair.T)
    A = adjoint(T)
    return T, None if pair.covariance is None else A @ pair.covariance @ A.T


def _sum(a: np.ndarray | None, b: np.ndarray | None) -> np.ndarray | None:
    return None if a is None or b is None else a + b


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
    """Cameras whose pose is known, of a format that cannot do without one.

    Raises:
        ConfigError: none is; it says why of one that is left out.
    """
    reference = calibration.reference.name
    cameras = [s.name for s in calibration.sensors if s.kind == "camera"]
    found = [name for name in cameras if calibration.between(reference, name) is not None]
    if found:
        return found
    lacking = {words_of(edge) for name in cameras for edge in calibration.way(reference, name) or ()}
    reasons = {words: why for words, why in calibration.left_out.items() if words in lacking}
    pair, reason = next(iter(reasons.items()), ("camera_lidar", "there is no record of it"))
    raise ConfigError(f"export {by}", pair, f"the format needs it: {reason}")


def needed_camera(calibration: ExportedCalibration, by: str, sensor: str) -> Camera:
    """A camera's intrinsics, for a format that cannot do without.

    Raises:
        ConfigError: they are not known.
    """
    camera = calibration.camera_of(sensor)
    if camera is None:
        problem = "the format needs intrinsics, and the lake has no observations of these days any more"
        raise ConfigError(f"export {by}", sensor, problem)
    return camera

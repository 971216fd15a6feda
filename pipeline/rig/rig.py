"""A rig in fleet.toml: sensors by name, reference sensor, edges."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any, Final, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import (
    Field,
    field_validator,
    model_validator,
)

from pipeline.core.errors import ConfigError
from pipeline.core.rigs import (
    CameraTopics,
    EgoTopics,
    LidarTopics,
    OnnxSemantics,
    PriorConfig,
    RadarTopics,
    Section,
    SensorPrior,
    TopicSemantics,
)
from pipeline.rig.graph import BASE, KINDS, Edge, Sensor, edge_between, possible_edges
from pipeline.rig.se3 import exp_so3, from_rotation_translation

__all__ = ["SECTIONS", "TURN_AXES", "Rig", "sensor_turn"]

SECTIONS: Final = {
    "camera": "cameras",
    "lidar": "lidars",
    "radar": "radars",
}  # Kind -> section of its sensors in a rig.
# Names are file names in the lake, keys of maps and ends of edges.
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
_Topics = TypeVar("_Topics")
TURN_AXES = ("azimuth", "elevation", "roll")
# A camera looks along z of its frame, other sensors look along x.
_OF_CAMERA = {"azimuth": 1, "elevation": 0, "roll": 2}
_OF_OTHERS = {"azimuth": 2, "elevation": 1, "roll": 0}


class Rig(Section):
    """One rig model; each vehicle names its rig. At least two of its sensors can have an edge.

    `[rigs.X.camera]` is short for `[rigs.X.cameras.camera]`, likewise lidar and radar. A rig without other
    sensors is dumped in the short form.
    """

    cameras: dict[str, CameraTopics] = Field(default_factory=dict)
    lidars: dict[str, LidarTopics] = Field(default_factory=dict)
    radars: dict[str, RadarTopics] = Field(default_factory=dict)
    ego: EgoTopics | None = None
    prior: PriorConfig = PriorConfig()
    reference: str | None = None  # reference sensor of the poses; None = the lidar with most edges
    base: str | None = Field(
        default=None, min_length=1
    )  # frame id of the vehicle frame; None = no edges to it
    # Height of the road in the base frame, e.g. negative for a base at an axle. Not in dumps, like the
    # following fields.
    road_z_m: float = Field(default=0.0, exclude=True)
    # Pairs of sensors; None = from overlap. Not in dumps: a change does not require ingest to run again.
    edges: tuple[tuple[str, str], ...] | None = Field(default=None, exclude=True)
    # Camera, lidar and radar for methods of three sensors; None = those with the largest overlap. Not in
    # dumps.
    three: tuple[str, str, str] | None = Field(default=None, exclude=True)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of its cameras, lidars and radars."""
        return (*self.cameras, *self.lidars, *self.radars)

    @property
    def nodes(self) -> tuple[Sensor, ...]:
        """Its sensors, and the vehicle frame if configured."""
        own = tuple(Sensor(name, kind) for kind, of in self._of_kind.items() for name in of)
        return own if self.base is None else (*own, BASE)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of its sensors."""
        return tuple(kind for kind, of in self._of_kind.items() if of)

    def of_sensors(self, names: Collection[str]) -> Rig:
        """The rig with a subset of its sensors, and with the vehicle frame if `base` is in the names."""
        kept = {
            section: {name: topics for name, topics in self._of_kind[kind].items() if name in names}
            for kind, section in SECTIONS.items()
        }
        edges = None if self.edges is None else tuple(e for e in self.edges if set(e) <= set(names))
        base = self.base if BASE.name in names else None
        three = self.three if self.three is not None and set(self.three) <= set(names) else None
        return self.model_copy(update={**kept, "edges": edges, "base": base, "three": three})

    @property
    def is_one_of_each(self) -> bool:
        """True for at most one camera, one lidar and one radar, and no vehicle frame: for three-sensor methods."""
        return self.base is None and all(len(of) <= 1 for of in self._of_kind.values())

    @property
    def named_edges(self) -> tuple[Edge, ...] | None:
        """Edges named in the file; None if they are found from overlap."""
        if self.edges is None:
            return None
        nodes = {node.name: node for node in self.nodes}
        return tuple(edge_between(nodes[a], nodes[b]) for a, b in self.edges)

    def one_of_each(self, what: str) -> dict[str, str]:
        """Sensor names by kind, for a consumer `what` of one camera, one lidar and one radar.

        Raises:
            ConfigError: the rig has several sensors of a kind, and `three` names none of them.
        """
        if self.three is not None:
            return dict(zip(self._of_kind, self.three, strict=True))
        if any(len(of) > 1 for of in self._of_kind.values()):
            problem = (
                f"{what} takes one camera, one lidar and one radar, and the rig has {_listed(self.sensors)}"
            )
            raise ConfigError(
                "fleet.toml", "rigs.*.three", f"{problem}: name which, three = [CAMERA, LIDAR, RADAR]"
            )
        return {kind: name for kind, of in self._of_kind.items() for name in of}

    @property
    def camera(self) -> CameraTopics | None:
        """The only camera; None if there is none, ConfigError if there are several."""
        return _only("cameras", self.cameras)

    @property
    def lidar(self) -> LidarTopics | None:
        """The only lidar; None if there is none, ConfigError if there are several."""
        return _only("lidars", self.lidars)

    @property
    def radar(self) -> RadarTopics | None:
        """The only radar; None if there is none, ConfigError if there are several."""
        return _only("radars", self.radars)

    @property
    def semantics(self) -> TopicSemantics | OnnxSemantics | None:
        """Source of labels and road users of the only camera; None without a camera or semantics."""
        return None if self.camera is None else self.camera.semantics

    @property
    def told_to_calibrate(self) -> dict[str, Any]:
        """Settings for calibration that dumps leave out, for its work key; empty if all are defaults."""
        told: dict[str, Any] = {"edges": self.edges, "three": self.three}
        told["priors"] = {
            name: of[name].prior.model_dump(exclude_none=True)
            for of in self._of_kind.values()
            for name in of
            if "prior" in of[name].model_fields_set
        }
        told |= {"road_z_m": self.road_z_m, "heights": self.measured_heights}
        return {key: value for key, value in told.items() if value}

    @property
    def measured_heights(self) -> dict[str, tuple[float, float]]:
        """Measured heights of lidars above the road: metres, and sigma."""
        found = ((name, of.height_m, of.height_sigma_m) for name, of in self.lidars.items())
        return {
            name: (height, sigma) for name, height, sigma in found if height is not None and sigma is not None
        }

    def prior_of(self, name: str) -> SensorPrior:
        """Sigmas of a sensor's prior: from its section, else the rig's."""
        own = next((of[name].prior for of in self._of_kind.values() if name in of), SensorPrior())
        rotation, translation = own.rotation_sigma_deg, own.translation_sigma_m
        return SensorPrior(
            rotation_sigma_deg=rotation or self.prior.rotation_sigma_deg,
            translation_sigma_m=translation or self.prior.translation_sigma_m,
        )

    def named_models(self) -> Iterator[tuple[str, str]]:
        """Model files named by its sensors, each with its key in the rig's section."""
        for kind, of in self._of_kind.items():
            for name, sensor in of.items():
                # Use the short key if possible.
                key = kind if name == kind else f"{SECTIONS[kind]}.{name}"
                yield from ((f"{key}.{part}", file) for part, file in sensor.named_models())

    @property
    def _of_kind(self) -> Mapping[Any, Mapping[str, CameraTopics | LidarTopics | RadarTopics]]:
        return {"camera": self.cameras, "lidar": self.lidars, "radar": self.radars}

    @model_validator(mode="before")
    @classmethod
    def _long_form(cls, values: Any) -> Any:
        """Expand `[rigs.X.camera]` to its long form."""
        if not isinstance(values, dict):
            return values
        values = dict(values)
        for kind, section in SECTIONS.items():
            one = values.pop(kind, None)
            if one is not None and section in values:
                raise ValueError(
                    f"both {kind} and {section}: {kind} is short for {section}.{kind}, so name all as {section}.NAME"
                )
            values |= {} if one is None else {section: {kind: one}}
        return values

    @field_validator("reference", mode="before")
    @classmethod
    def _one_reference(cls, value: Any) -> Any:
        if value is not None and not isinstance(value, str):
            raise ValueError(f"the reference is one sensor, not {value}")
        return value

    @model_validator(mode="after")
    def _names_are_its_own(self) -> Rig:
        for name, kind in ((name, kind) for kind, of in self._of_kind.items() for name in of):
            if not _NAME.fullmatch(name):
                raise ValueError(f"{SECTIONS[kind]}.{name}: a sensor's name may have letters, digits and _")
            if name in KINDS and name != kind:
                raise ValueError(
                    f"{SECTIONS[kind]}.{name}: {name} is the name of another kind; rename the {kind}"
                )
        twice = sorted({name for name in self.sensors if self.sensors.count(name) > 1})
        if twice:
            raise ValueError(
                f"two sensors are called {', '.join(twice)}: records identify sensors by name, so rename one"
            )
        return self

    @model_validator(mode="after")
    def _reference_is_a_sensor(self) -> Rig:
        if self.reference is not None and self.reference not in self.sensors:
            raise ValueError(
                f"reference = {self.reference!r} is no sensor of the rig, which has {_listed(self.sensors)}"
            )
        if self.reference is not None:
            kept = next(of[self.reference] for of in self._of_kind.values() if self.reference in of)
            if "prior" in kept.model_fields_set:
                raise ValueError(f"{self.reference} is the reference, which has no prior: remove its prior")
        return self

    @model_validator(mode="after")
    def _edges_join_its_sensors(self) -> Rig:
        nodes = {node.name: node for node in self.nodes}
        if not possible_edges(self.nodes):
            has = (
                f"only a {next(iter(nodes.values())).kind}"
                if len(nodes) == 1
                else _listed(nodes) or "no sensor"
            )
            raise ValueError(
                f"the rig has {has}: a calibration needs two of camera, lidar and radar, two lidars, or base"
            )
        for a, b in self.edges or ():
            unknown = [name for name in (a, b) if name not in nodes]
            if unknown:
                why = " (set base = to the vehicle's frame)" if unknown == [BASE.name] else ""
                raise ValueError(f"edge [{a}, {b}]: the rig has {_listed(nodes)}, but no {unknown[0]}{why}")
            try:
                edge_between(nodes[a], nodes[b])
            except ValueError as err:
                raise ValueError(f"edge [{a}, {b}]: {err}") from err
        return self

    @model_validator(mode="after")
    def _heights_are_over_the_road_under_base(self) -> Rig:
        if self.base is None and (self.measured_heights or self.road_z_m):
            key = "road_z_m" if self.road_z_m else f"lidars.{next(iter(self.measured_heights))}.height_m"
            raise ValueError(f"{key} needs the vehicle frame: set base = ...")
        return self

    @model_validator(mode="after")
    def _edges_stand_once(self) -> Rig:
        ends = [frozenset(edge) for edge in self.edges or ()]
        twice = next((end for end in ends if ends.count(end) > 1), None)
        if twice is not None:
            raise ValueError(f"edge [{_listed(sorted(twice))}] occurs twice")
        if self.edges == ():
            raise ValueError("edges is empty: remove it to find edges from overlap")
        return self

    @model_validator(mode="after")
    def _three_are_one_of_each_kind(self) -> Rig:
        if self.three is not None and any(
            name not in of for name, of in zip(self.three, self._of_kind.values(), strict=True)
        ):
            raise ValueError(
                f"three = [{_listed(self.three)}]: name a camera, a lidar and a radar of the rig"
            )
        return self

    @model_validator(mode="after")
    def _topics_differ(self) -> Rig:
        roles: dict[str, list[str]] = {}
        for role, topic in self._topics():
            roles.setdefault(topic, []).append(role)
        twice = [f"{topic} ({' and '.join(of)})" for topic, of in sorted(roles.items()) if len(of) > 1]
        if twice:
            raise ValueError(f"one topic has two roles: {', '.join(twice)}")
        return self

    def _topics(self) -> Iterator[tuple[str, str]]:
        """All topics, each with its meaning."""
        for name, camera in self.cameras.items():
            yield f"image of {name}", camera.image
            yield f"info of {name}", camera.info
            if isinstance(camera.semantics, TopicSemantics):
                yield f"labels of {name}", camera.semantics.labels
                yield f"detections of {name}", camera.semantics.detections
        yield from ((f"points of {name}", lidar.points) for name, lidar in self.lidars.items())
        for name, radar in self.radars.items():
            yield f"points of {name}", radar.points
        yield "prior", self.prior.topic
        if self.ego is not None:
            yield "odometry", self.ego.odometry


def _listed(names: Any) -> str:
    return ", ".join(names)


def _only(section: str, of: Mapping[str, _Topics]) -> _Topics | None:
    if len(of) > 1:
        problem = f"this command supports one of {section}, and the rig has {_listed(of)}"
        raise ConfigError("fleet.toml", f"rigs.*.{section}", problem)
    return next(iter(of.values()), None)


def sensor_turn(axis: str, angle_rad: float, *, of_camera: bool) -> Float[np.ndarray, "4 4"]:
    """T_sensor_turned."""
    omega = np.zeros(3)
    omega[(_OF_CAMERA if of_camera else _OF_OTHERS)[axis]] = angle_rad
    return from_rotation_translation(exp_so3(omega), np.zeros(3))

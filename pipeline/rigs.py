"""What fleet.toml says of a rig: topics of its sensors, what its radar's numbers mean, where its prior comes from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from schemas.calibrations import SENSORS

__all__ = [
    "CameraPrior",
    "CameraTopics",
    "EgoTopics",
    "LidarTopics",
    "OnnxDrivable",
    "OnnxPointSemantics",
    "OnnxSemantics",
    "Positive",
    "PriorConfig",
    "RadarTopics",
    "Rig",
    "Section",
    "TopicSemantics",
]

Positive = Annotated[float, Field(gt=0)]
Topic = Annotated[str, Field(pattern=r"^/\S+$")]
TF_STATIC = "/tf_static"
# By the unit in a number's name, the least and the most that it can mean on a car. 0 has a meaning of its own.
_OF_THIS_WORLD = {"deg": (1e-4, 180.0), "m": (1e-4, 1e3), "s": (1e-6, 86_400.0), "mps": (0.01, 1000.0)}
# What labels can mean (Cityscapes' classes), and which of them are road users.
StreetClass = Literal[
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation",
    "terrain", "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle",
]  # fmt: skip
RoadUser = Literal["person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle"]
LabelId = Annotated[int, Field(ge=0, le=255)]


class Section(BaseModel):
    """A section of fleet.toml: unknown keys, nan and inf are errors, and nothing changes after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="after")
    @classmethod
    def _is_of_this_world(cls, value: Any, info: Any) -> Any:
        """A number is one of its unit: 180 deg is all there is, and no car's radar measures nanometres a second."""
        unit = (info.field_name or "").rpartition("_")[2]
        least, most = _OF_THIS_WORLD.get(unit, (0.0, math.inf))
        if isinstance(value, float) and value and not least <= abs(value) <= most:
            raise ValueError(f"{value:g} {unit} is not between {least:g} and {most:g} {unit}")
        return value


class TopicSemantics(Section):
    """Semantics that the car already logged."""

    source: Literal["topics"]
    labels: Topic
    detections: Topic
    # One of these, or a set of one's own: { road = [7, 8], car = [26], ... }; labels that it leaves out mean nothing.
    label_set: Literal["cityscapes", "ade20k", "coco"] | dict[StreetClass, tuple[LabelId, ...]] = "cityscapes"
    # Of a detector that logs numbers or names of its own: { "2" = "car", ... }, as logged.
    classes: dict[str, RoadUser] = Field(default_factory=dict, exclude_if=lambda classes: not classes)

    @model_validator(mode="after")
    def _a_label_means_one_thing(self) -> TopicSemantics:
        groups = self.label_set.values() if isinstance(self.label_set, dict) else ()
        ids = [label for group in groups for label in group]
        twice = sorted({label for label in ids if ids.count(label) > 1})
        if twice:
            raise ValueError(f"label_set gives two meanings to {', '.join(map(str, twice))}")
        return self


class OnnxSemantics(Section):
    """Semantics computed here by ONNX models; paths of manifests, relative to fleet.toml."""

    source: Literal["onnx"]
    segmenter: str
    detector: str


@dataclass(frozen=True)
class CameraPrior:
    """What is known of a camera beside its CameraInfo."""

    readout_s: float = 0.0
    # Target calibrations repeated with other pictures of the same camera scatter by some tenths of a percent and by one
    # or two pixels (Zhang 2000, table 2); the better ones of these.
    focal_sigma: float = 0.003
    centre_sigma_px: float = 1.0
    centre_is_stated: bool = (
        False  # else nobody promised it: enough to doubt a day, not to certify the camera's turn
    )


class CameraTopics(Section):
    """The camera's topics, and what CameraInfo does not say."""

    image: Topic
    info: Topic
    semantics: Annotated[TopicSemantics | OnnxSemantics, Field(discriminator="source")]
    # Rolling shutter: time from the first image row to the last, which is seen later [s]; 0 = global shutter. The stamp
    # is that of the middle row; where it is another row's, the time offset that is estimated takes that up. Left out of
    # dumps: it is calibration's, and no reason to ingest a rig's logs again.
    readout_s: Annotated[float, Field(ge=0, le=0.1)] = Field(default=0.0, exclude=True)

    # How surely CameraInfo is right (1 sigma): focal length, and principal point in either direction.
    # 0 = surely: the day then needs no more than its own sigma to contradict it. With `centre_sigma_px` records can
    # certify how the camera is mounted; without it only where things appear in the image with this CameraInfo.
    focal_sigma_relative: Annotated[float, Field(ge=0, le=0.05)] = Field(
        default=CameraPrior.focal_sigma, exclude=True
    )
    centre_sigma_px: Annotated[float, Field(ge=0, le=100)] | None = Field(default=None, exclude=True)

    @property
    def known(self) -> CameraPrior:
        """What calibration takes as known of the camera."""
        known = CameraPrior(self.readout_s, self.focal_sigma_relative)
        if self.centre_sigma_px is None:
            return known
        return replace(known, centre_sigma_px=self.centre_sigma_px, centre_is_stated=True)


class OnnxPointSemantics(Section):
    """What lidar points are, computed here by a range-image model; path of its manifest, relative to fleet.toml."""

    source: Literal["onnx"]
    segmenter: str
    remission_scale: Positive = 1.0  # makes logged intensity what the model was trained on


class LidarTopics(Section):
    """The lidar's topic."""

    points: Topic
    # None = from geometry. Left out of dumps: it is perception's, and no reason to ingest a rig's logs again.
    semantics: OnnxPointSemantics | None = Field(default=None, exclude=True)


class OnnxDrivable(Section):
    """The radar's drivable area computed here by a network; path of its manifest, relative to fleet.toml."""

    source: Literal["onnx"]
    model: str


class RadarTopics(Section):
    """The radar's topic and what its Doppler means."""

    points: Topic
    doppler_field: str = "doppler"
    doppler_positive: Literal["approaching", "receding"] = "receding"
    doppler_period_mps: Positive | None = None
    # ["vx", "vy"] or three: components of the velocity relative to the radar, in its axes, of a cloud without a Doppler
    # field. Ego-compensated ones (over ground) say nothing of the radar's pose and must not be named here.
    velocity_fields: tuple[str, str] | tuple[str, str, str] | None = Field(
        default=None, exclude_if=lambda fields: fields is None
    )
    azimuth_positive: Literal["left", "right"] = "left"  # RadarScan drivers differ; PointCloud2 has x y z
    # None = from geometry. Left out of dumps: it is perception's, and no reason to ingest a rig's logs again.
    drivable: OnnxDrivable | None = Field(default=None, exclude=True)

    @model_validator(mode="after")
    def _one_way_to_say_velocity(self) -> RadarTopics:
        both = {"doppler_field", "doppler_positive"} & self.model_fields_set
        if self.velocity_fields is not None and both:
            raise ValueError(
                f"velocity_fields stands in place of {' and '.join(sorted(both))}: leave one out"
            )
        return self


class EgoTopics(Section):
    """Optional ego motion."""

    odometry: Topic


class PriorConfig(Section):
    """Where the prior comes from and how far to trust it."""

    source: Literal["tf_static", "file"] = "tf_static"
    # Where static transforms are logged: ROS's name; Foxglove's loggers have no custom. Left out of dumps where it is
    # that: no reason to ingest a rig's logs again.
    topic: Topic = Field(default=TF_STATIC, exclude_if=lambda topic: topic == TF_STATIC)
    file: str | None = None  # JSON: {"T_camera_lidar": 4x4, "T_lidar_radar": 4x4}, relative to fleet.toml
    rotation_sigma_deg: Positive = 2.0
    translation_sigma_m: Positive = 0.05

    @model_validator(mode="after")
    def _file_goes_with_source(self) -> PriorConfig:
        if (self.source == "file") != (self.file is not None):
            raise ValueError('source = "file" needs file = "...", and file needs source = "file"')
        return self


class Rig(Section):
    """One rig model; a vehicle names its rig. It has at least two of the three sensors."""

    camera: CameraTopics | None = None
    lidar: LidarTopics | None = None
    radar: RadarTopics | None = None
    ego: EgoTopics | None = None
    prior: PriorConfig = PriorConfig()

    @property
    def sensors(self) -> tuple[str, ...]:
        """Those of camera, lidar and radar that it has."""
        return tuple(sensor for sensor in SENSORS if getattr(self, sensor) is not None)

    @property
    def semantics(self) -> TopicSemantics | OnnxSemantics | None:
        """Where the camera's labels and road users come from; None without a camera."""
        return None if self.camera is None else self.camera.semantics

    @model_validator(mode="after")
    def _two_sensors(self) -> Rig:
        if len(self.sensors) < 2:
            has = f"only a {self.sensors[0]}" if self.sensors else "no sensor"
            raise ValueError(f"the rig has {has}: a calibration needs two of camera, lidar and radar")
        return self

    @model_validator(mode="after")
    def _topics_differ(self) -> Rig:
        semantics = self.semantics
        topics = [] if self.camera is None else [self.camera.image, self.camera.info]
        topics += [sensor.points for sensor in (self.lidar, self.radar) if sensor is not None]
        topics.append(self.prior.topic)
        topics += [semantics.labels, semantics.detections] if isinstance(semantics, TopicSemantics) else []
        topics += [] if self.ego is None else [self.ego.odometry]
        twice = sorted({topic for topic in topics if topics.count(topic) > 1})
        if twice:
            raise ValueError(f"one topic stands for two things: {', '.join(twice)}")
        return self

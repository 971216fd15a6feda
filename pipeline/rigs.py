"""What fleet.toml says of sensors: their topics, what a radar's numbers mean, where the prior comes from."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

__all__ = [
    "AlignmentFields",
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
    "Section",
    "SensorPrior",
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


class SensorPrior(Section):
    """How far one sensor's prior is to be trusted, where that is not the rig's."""

    rotation_sigma_deg: Positive | None = None
    translation_sigma_m: Positive | None = None


class _Sensor(Section):
    """What every sensor may be told."""

    # Left out of dumps: it is calibration's, and no reason to ingest a rig's logs again.
    prior: SensorPrior = Field(default=SensorPrior(), exclude=True)


class CameraTopics(_Sensor):
    """A camera's topics, and what CameraInfo does not say."""

    image: Topic
    info: Topic
    # Left out: only what needs no labels and no road users can be made of its images.
    semantics: Annotated[TopicSemantics | OnnxSemantics, Field(discriminator="source")] | None = None
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

    def named_models(self) -> Iterator[tuple[str, str]]:
        """Files of models that it names, by key."""
        if isinstance(self.semantics, OnnxSemantics):
            yield "semantics.segmenter", self.semantics.segmenter
            yield "semantics.detector", self.semantics.detector

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


class LidarTopics(_Sensor):
    """A lidar's topic."""

    points: Topic
    # None = from geometry. Left out of dumps: it is perception's, and no reason to ingest a rig's logs again.
    semantics: OnnxPointSemantics | None = Field(default=None, exclude=True)
    # Over the road, as somebody measured it, and how well: for the edge to the vehicle frame.
    height_m: Positive | None = Field(default=None, exclude=True)
    height_sigma_m: Positive | None = Field(default=None, exclude=True)

    @model_validator(mode="after")
    def _height_has_a_sigma(self) -> LidarTopics:
        if (self.height_m is None) != (self.height_sigma_m is None):
            raise ValueError("height_m and height_sigma_m go together: say both, or neither")
        return self

    def named_models(self) -> Iterator[tuple[str, str]]:
        """Files of models that it names, by key."""
        if self.semantics is not None:
            yield "semantics.segmenter", self.semantics.segmenter


class OnnxDrivable(Section):
    """The radar's drivable area computed here by a network; path of its manifest, relative to fleet.toml."""

    source: Literal["onnx"]
    model: str


class AlignmentFields(Section):
    """Where a message says how a radar is misaligned: paths as `packet.theta`, `-packet.theta` of the opposite sign.

    Azimuth is positive to the left, elevation upwards. A message may hold one of the two.
    """

    azimuth: str | None = None
    elevation: str | None = None
    azimuth_variance: str | None = None
    elevation_variance: str | None = None
    status: str | None = None
    unit: Literal["rad", "deg"] = "rad"  # of the angles; variances are in its square

    @model_validator(mode="after")
    def _states_an_angle(self) -> AlignmentFields:
        if self.azimuth is None and self.elevation is None:
            raise ValueError("name the field of the azimuth, of the elevation, or both")
        return self


class RadarTopics(_Sensor):
    """A radar's topic and what its Doppler means."""

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
    # Messages of its own estimate of its misalignment; one topic may stand without brackets. Left out of dumps where
    # there is none.
    alignment: tuple[Topic, ...] = Field(default=(), exclude_if=lambda topics: not topics)
    alignment_fields: AlignmentFields | None = Field(default=None, exclude_if=lambda fields: fields is None)
    # None = from geometry. Left out of dumps: it is perception's, and no reason to ingest a rig's logs again.
    drivable: OnnxDrivable | None = Field(default=None, exclude=True)

    def named_models(self) -> Iterator[tuple[str, str]]:
        """Files of models that it names, by key."""
        if self.drivable is not None:
            yield "drivable.model", self.drivable.model

    @field_validator("alignment", mode="before")
    @classmethod
    def _one_topic_is_a_list(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _fields_are_of_a_topic(self) -> RadarTopics:
        if self.alignment_fields is not None and not self.alignment:
            raise ValueError("alignment_fields are of a message: name its topic, alignment = ...")
        return self

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
    # JSON, relative to fleet.toml: {"reference": "top", "T": {"front": 4x4, ...}} with T_reference_sensor of each
    # sensor; of a short-form rig also {"T_camera_lidar": 4x4, "T_lidar_radar": 4x4}.
    file: str | None = None
    rotation_sigma_deg: Positive = 2.0
    translation_sigma_m: Positive = 0.05

    @model_validator(mode="after")
    def _file_goes_with_source(self) -> PriorConfig:
        if (self.source == "file") != (self.file is not None):
            raise ValueError('source = "file" needs file = "...", and file needs source = "file"')
        return self

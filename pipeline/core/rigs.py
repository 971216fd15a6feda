"""Sensors in fleet.toml: their topics, the meaning of radar values, and the source of the prior."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

__all__ = [
    "CameraPrior", "CameraTopics", "EgoTopics", "LidarTopics", "OnnxDrivable", "OnnxPointSemantics",
    "OnnxSemantics", "Positive", "PriorConfig", "RadarTopics", "Section", "SensorPrior", "TopicSemantics",
]  # fmt: skip

Positive = Annotated[float, Field(gt=0)]
Topic = Annotated[str, Field(pattern=r"^/\S+$")]
TF_STATIC = "/tf_static"
_MODELS = ("segmenter", "detector", "model")  # keys of a network that name a file
# Plausible range of a value on a car, by the unit at the end of its name. 0 is always allowed and has its own
# meaning.
_OF_THIS_WORLD = {"deg": (1e-4, 180.0), "m": (1e-4, 1e3), "s": (1e-6, 86_400.0), "mps": (0.01, 1000.0)}
# Classes that labels can stand for (those of Cityscapes), and the road users among them.
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
        """Refuse a value outside the plausible range of its unit, such as an angle above 180 deg."""
        unit = (info.field_name or "").rpartition("_")[2]
        least, most = _OF_THIS_WORLD.get(unit, (0.0, math.inf))
        if isinstance(value, float) and value and not least <= abs(value) <= most:
            raise ValueError(f"{value:g} {unit} is not between {least:g} and {most:g} {unit}")
        return value


class TopicSemantics(Section):
    """Semantics that are in the log already."""

    source: Literal["topics"]
    labels: Topic
    detections: Topic
    # One of these sets, or a table such as { road = [7, 8], car = [26], ... }; other label values are
    # ignored.
    label_set: Literal["cityscapes", "ade20k", "coco"] | dict[StreetClass, tuple[LabelId, ...]] = "cityscapes"
    # For a detector that logs other names or numbers: { "2" = "car", ... }, with the names as logged.
    classes: dict[str, RoadUser] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _a_label_means_one_thing(self) -> TopicSemantics:
        groups = self.label_set.values() if isinstance(self.label_set, dict) else ()
        ids = [label for group in groups for label in group]
        twice = sorted({label for label in ids if ids.count(label) > 1})
        if twice:
            raise ValueError(f"label_set gives two meanings to {', '.join(map(str, twice))}")
        return self


class OnnxSemantics(Section):
    """Semantics computed by ONNX models; paths of manifests, relative to fleet.toml."""

    source: Literal["onnx"]
    segmenter: str
    detector: str


@dataclass(frozen=True)
class CameraPrior:
    """Prior knowledge of a camera in addition to its CameraInfo."""

    readout_s: float = 0.0
    # Repeated target calibrations of one camera with new pictures scatter by some tenths of a percent and by
    # one or two pixels (Zhang 2000, table 2); these are the better of those values.
    focal_sigma: float = 0.003
    centre_sigma_px: float = 1.0
    # False = a default: enough to doubt a day, not enough to certify the camera's rotation.
    centre_is_stated: bool = False
    stamp_sigma_s: float | None = None  # None = its clock is unknown


class SensorPrior(Section):
    """Sigmas of one sensor's prior, if they differ from those of the rig."""

    rotation_sigma_deg: Positive | None = None
    translation_sigma_m: Positive | None = None


class _Sensor(Section):
    """Settings that every sensor has."""

    # Left out of dumps: only calibration uses it, so a change must not ingest a rig's logs again.
    prior: SensorPrior = Field(default=SensorPrior(), exclude=True)

    def named_models(self) -> Iterator[tuple[str, str]]:
        """Model files of this sensor as (key, path)."""
        for key in ("semantics", "drivable"):
            network = getattr(self, key, None)
            if network is not None and network.source == "onnx":
                yield from ((f"{key}.{of}", file) for of, file in network if of in _MODELS)


class CameraTopics(_Sensor):
    """Topics of a camera, and what CameraInfo does not contain."""

    image: Topic
    info: Topic
    # None = only steps that need neither labels nor road users use the camera's images.
    semantics: Annotated[TopicSemantics | OnnxSemantics, Field(discriminator="source")] | None = None
    # Rolling shutter: time from the first image row to the last, which is exposed later [s]; 0 = global
    # shutter. The stamp is that of the middle row; if it is another row's, the estimated time offset absorbs
    # the difference. Left out of dumps: only calibration uses it, so a change must not ingest a rig's logs
    # again.
    readout_s: Annotated[float, Field(ge=0, le=0.1)] = Field(default=0.0, exclude=True)

    # 1-sigma accuracy of CameraInfo: focal length, and principal point in each direction.
    # 0 = treat CameraInfo as exact: only the day's own sigma is used in the test. With `centre_sigma_px`
    # records can certify the mounting of the camera; without it only the positions of objects in images with
    # this CameraInfo.
    focal_sigma_relative: Annotated[float, Field(ge=0, le=0.05)] = Field(
        default=CameraPrior.focal_sigma, exclude=True
    )
    centre_sigma_px: Annotated[float, Field(ge=0, le=100)] | None = Field(default=None, exclude=True)

    # 1-sigma accuracy of its stamps on the lidar's clock, where one clock is kept for both (PTP); by default, the clock
    # is found with the mounting, which makes a camera that looks aside three times less sure.
    stamp_sigma_s: Annotated[float, Field(gt=0, le=0.05)] | None = Field(default=None, exclude=True)

    @property
    def known(self) -> CameraPrior:
        """Prior knowledge of the camera for calibration."""
        known = CameraPrior(self.readout_s, self.focal_sigma_relative, stamp_sigma_s=self.stamp_sigma_s)
        if self.centre_sigma_px is None:
            return known
        return replace(known, centre_sigma_px=self.centre_sigma_px, centre_is_stated=True)


class OnnxPointSemantics(Section):
    """Classes of lidar points from a range-image model; path of its manifest, relative to fleet.toml."""

    source: Literal["onnx"]
    segmenter: str
    # factor from logged intensity to the remission that the model was trained on
    remission_scale: Positive = 1.0


class LidarTurn(Section):
    """How a lidar turns, seen from above: for clouds without a time per point. The azimuth grows to the left."""

    sense: Literal["left", "right"]
    begins_deg: Annotated[float, Field(ge=-180, le=180)]
    period_s: Positive = 0.1
    stamp: Literal["begin", "middle", "end"] = "middle"  # of the turn


class LidarTopics(_Sensor):
    """Topic of a lidar, its height if measured, and how it turns, for clouds without times."""

    points: Topic
    # None = from geometry. Left out of dumps: only perception uses it, so a change must not ingest a rig's
    # logs again.
    semantics: OnnxPointSemantics | None = Field(default=None, exclude=True)
    # Measured height above the road and its sigma, for the edge to the vehicle frame.
    height_m: Positive | None = Field(default=None, exclude=True)
    height_sigma_m: Positive | None = Field(default=None, exclude=True)
    # Only perception uses it, like `semantics`. None = from the sweeps of a car that moves.
    turn: LidarTurn | None = Field(default=None, exclude=True)

    @model_validator(mode="after")
    def _height_has_a_sigma(self) -> LidarTopics:
        if (self.height_m is None) != (self.height_sigma_m is None):
            raise ValueError("height_m and height_sigma_m go together: give both, or neither")
        return self


class OnnxDrivable(Section):
    """Drivable area of the radar, computed by a network; path of its manifest, relative to fleet.toml."""

    source: Literal["onnx"]
    model: str


class RadarTopics(_Sensor):
    """Topic of a radar, and the meaning of its Doppler field."""

    points: Topic
    doppler_field: str = "doppler"
    doppler_positive: Literal["approaching", "receding"] = "receding"
    doppler_period_mps: Positive | None = None
    # ["vx", "vy"] or three names: components of the velocity relative to the radar, in radar axes, for a
    # cloud without a Doppler field. Ego-compensated velocities (over ground) contain no information on the
    # radar's pose and must not be named here.
    velocity_fields: tuple[str, str] | tuple[str, str, str] | None = None
    # drivers that log RadarScan differ; PointCloud2 has x y z
    azimuth_positive: Literal["left", "right"] = "left"
    # None = from geometry. Left out of dumps: only perception uses it, so a change must not ingest a rig's
    # logs again.
    drivable: OnnxDrivable | None = Field(default=None, exclude=True)

    @model_validator(mode="after")
    def _one_way_to_say_velocity(self) -> RadarTopics:
        both = {"doppler_field", "doppler_positive"} & self.model_fields_set
        if self.velocity_fields is not None and both:
            raise ValueError(f"velocity_fields replaces {' and '.join(sorted(both))}: leave one out")
        return self


class EgoTopics(Section):
    """Topic of the ego motion (optional)."""

    odometry: Topic


class PriorConfig(Section):
    """Source of the prior and its sigmas."""

    source: Literal["tf_static", "file"] = "tf_static"
    # Topic of static transforms; Foxglove's loggers have no fixed name.
    topic: Topic = TF_STATIC
    # JSON, relative to fleet.toml: {"reference": "top", "T": {"front": 4x4, ...}} with T_reference_sensor of
    # each sensor; for a rig in the short form also {"T_camera_lidar": 4x4, "T_lidar_radar": 4x4}.
    file: str | None = None
    rotation_sigma_deg: Positive = 2.0
    translation_sigma_m: Positive = 0.05

    @model_validator(mode="after")
    def _file_goes_with_source(self) -> PriorConfig:
        if (self.source == "file") != (self.file is not None):
            raise ValueError('source = "file" needs file = "...", and file needs source = "file"')
        return self

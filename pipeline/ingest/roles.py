"""Role of a topic in the rig: the sensor, and the kind of content."""

from __future__ import annotations

from typing import Final, NamedTuple

from pipeline.core.rigs import TopicSemantics
from pipeline.rig.rig import Rig

__all__ = [
    "CAPTURED", "DETECTIONS", "INFO", "LABELS", "LIDAR", "NEEDED", "ODOMETRY", "RADAR", "TF_STATIC",
    "Role", "topics_of",
]  # fmt: skip

IMAGE, INFO, LABELS, DETECTIONS, LIDAR, RADAR = "image", "info", "labels", "detections", "lidar", "radar"
CAPTURED: Final = {"camera": IMAGE, "lidar": LIDAR, "radar": RADAR}  # by kind of sensor
NEEDED: Final = (IMAGE, INFO, LIDAR, RADAR)  # a sensor without one of these is missing


class Role(NamedTuple):
    """Content of a topic, and its sensor; no sensor for transforms and odometry."""

    what: str
    sensor: str = ""

    @property
    def kind(self) -> str:
        """Kind of the sensor."""
        return self.what if self.what in (LIDAR, RADAR) else "camera" if self.sensor else ""

    @property
    def is_capture(self) -> bool:
        """Whether it is a measurement of the sensor."""
        return self.what in CAPTURED.values()

    def __str__(self) -> str:
        return self.what if self.sensor in ("", self.kind) else f"{self.what} of {self.sensor}"


TF_STATIC, ODOMETRY = Role("tf_static"), Role("odometry")


def topics_of(rig: Rig) -> dict[str, Role]:
    """Role of each topic of the rig; the lidar that defines the moments comes first of the lidars."""
    topics: dict[str, Role] = {}
    for name, camera in rig.cameras.items():
        topics |= {camera.image: Role(IMAGE, name), camera.info: Role(INFO, name)}
    for name in sorted(rig.lidars, key=lambda lidar: lidar != rig.reference):
        topics[rig.lidars[name].points] = Role(LIDAR, name)
    for name in sorted(rig.radars, key=lambda radar: radar != rig.reference):
        topics[rig.radars[name].points] = Role(RADAR, name)
    topics[rig.prior.topic] = TF_STATIC
    for name, camera in rig.cameras.items():
        if isinstance(camera.semantics, TopicSemantics):
            topics[camera.semantics.labels] = Role(LABELS, name)
            topics[camera.semantics.detections] = Role(DETECTIONS, name)
    if rig.ego is not None:
        topics[rig.ego.odometry] = ODOMETRY
    return topics

"""What a topic of the rig is: which sensor's, and what of it."""

from __future__ import annotations

from typing import Final, NamedTuple

from pipeline.rig.rig import Rig
from pipeline.rigs import TopicSemantics

__all__ = [
    "ALIGNMENT", "CAPTURED", "DETECTIONS", "INFO", "LABELS", "LIDAR", "NEEDED", "ODOMETRY", "RADAR", "TF_STATIC",
    "Role", "topics_of",
]  # fmt: skip

IMAGE, INFO, LABELS, DETECTIONS, LIDAR, RADAR = "image", "info", "labels", "detections", "lidar", "radar"
ALIGNMENT = "alignment"
CAPTURED: Final = {"camera": IMAGE, "lidar": LIDAR, "radar": RADAR}  # by kind of sensor
NEEDED: Final = (IMAGE, INFO, LIDAR, RADAR)  # without which a sensor is missing


class Role(NamedTuple):
    """What a topic carries, and the sensor that it is of; none for transforms and odometry."""

    what: str
    sensor: str = ""

    @property
    def kind(self) -> str:
        """Of the sensor."""
        if self.what in (LIDAR, RADAR, ALIGNMENT):
            return LIDAR if self.what == LIDAR else RADAR
        return "camera" if self.sensor else ""

    @property
    def is_capture(self) -> bool:
        """Whether it is what the sensor measures."""
        return self.what in CAPTURED.values()

    def __str__(self) -> str:
        return self.what if self.sensor in ("", self.kind) else f"{self.what} of {self.sensor}"


TF_STATIC, ODOMETRY = Role("tf_static"), Role("odometry")


def topics_of(rig: Rig) -> dict[str, Role]:
    """Role of each topic that the rig names; the lidar that moments are built about comes first of lidars."""
    topics: dict[str, Role] = {}
    for name, camera in rig.cameras.items():
        topics |= {camera.image: Role(IMAGE, name), camera.info: Role(INFO, name)}
    for name in sorted(rig.lidars, key=lambda lidar: lidar != rig.reference):
        topics[rig.lidars[name].points] = Role(LIDAR, name)
    for name in sorted(rig.radars, key=lambda radar: radar != rig.reference):
        topics[rig.radars[name].points] = Role(RADAR, name)
    topics[rig.prior.topic] = TF_STATIC
    topics |= {topic: Role(ALIGNMENT, n) for n, radar in rig.radars.items() for topic in radar.alignment}
    for name, camera in rig.cameras.items():
        if isinstance(camera.semantics, TopicSemantics):
            topics[camera.semantics.labels] = Role(LABELS, name)
            topics[camera.semantics.detections] = Role(DETECTIONS, name)
    if rig.ego is not None:
        topics[rig.ego.odometry] = ODOMETRY
    return topics

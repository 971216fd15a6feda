"""Messages of a log for the measurements of one moment, faults included."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from pipeline.core.ros_messages import RosMessages
from pipeline.rig.topics import topics_of
from pipeline.simulate.faults import DayFaults, misread, swapped_with
from pipeline.simulate.sensors.data_sheets import LidarSpec, RadarSpec
from pipeline.simulate.sensors.lidar import Sweep
from pipeline.simulate.sensors.mounting import Mounting
from pipeline.simulate.sensors.radar import Scan
from pipeline.simulate.sensors.rig_spec import RigSpec, SensorSpec
from pipeline.simulate.sensors.semantics import Box, SemanticsSpec, encode_png
from pipeline.simulate.sensors.simulated_frame import Image, SimulatedFrame

__all__ = ["At", "Sent", "Setup", "messages_of"]

At = Callable[[float], int]  # stamp [ns] of a time of the drive [s]
Sent = tuple[int, str, Any]  # log time [ns], topic, message


@dataclass(frozen=True, eq=False)
class Setup:
    """A vehicle at one moment: rig, mounting, label networks, faults."""

    rig: RigSpec
    mounting: Mounting
    semantics: SemanticsSpec
    faults: DayFaults = field(default_factory=DayFaults)


def messages_of(
    messages: RosMessages, frame: SimulatedFrame, setup: Setup, at: At, rng: np.random.Generator
) -> list[Sent]:
    """The messages of one frame, `at` giving stamps by time of the drive; a missing sensor has none."""
    sent: list[Sent] = []
    for sensor in setup.rig.sensors:
        name = sensor.name
        if name not in frame.stamps_s or setup.faults.has("missing", name):
            continue
        stamp = at(frame.stamps_s[name])
        if name in frame.images:
            sent += _of_camera(messages, frame.images[name], setup, sensor, stamp, rng)
        else:
            columns = (
                _of_lidar(frame.sweeps[name], sensor)
                if name in frame.sweeps
                else _of_radar(frame.scans[name], sensor)
            )
            plug = _plugged(sensor, setup)
            # A reader gets the frame id from the driver of the swapped sensor.
            owner = plug if plug.kind == sensor.kind else sensor
            topic = topics_of(plug.name, plug.kind)["points"]
            sent.append((stamp, topic, messages.cloud(messages.at(stamp, owner.name), columns)))
    return sent


def _plugged(sensor: SensorSpec, setup: Setup) -> SensorSpec:
    """The sensor whose points are sent on this sensor's topic."""
    for fault in setup.faults.faults:
        if fault.kind == "swap":
            one = setup.rig[fault.sensor]
            other = swapped_with(one, setup.rig)
            if other is not None and sensor in (one, other):
                return other if sensor == one else one
    return sensor


def _of_camera(
    messages: RosMessages,
    image: Image,
    setup: Setup,
    sensor: SensorSpec,
    stamp: int,
    rng: np.random.Generator,
) -> list[Sent]:
    """An image with its intrinsics, labels and detections."""
    today, name = setup.faults, sensor.name
    info = misread(setup.mounting.camera(name)[1], today, name)
    labels = _permuted(image.labels_png, rng) if today.has("labels", name) else image.labels_png
    header = messages.at(stamp, name)
    made = {
        "info": messages.camera_info(header, info),
        "image": messages.image(header, image.jpeg, "jpeg"),
        "labels": messages.image(header, labels, "mono8; png compressed"),
        "detections": _detections(messages, header, image.boxes),
    }
    topics = topics_of(name, "camera")
    return [(stamp, topics[what], message) for what, message in made.items()]


def _detections(ros: RosMessages, header: Any, boxes: list[Box]) -> Any:
    """Detection2DArray; boxes in full-image pixels."""
    pose, items = ros.pose(np.eye(4), with_covariance=True), []
    for i, box in enumerate(boxes):
        hypothesis = ros.make("vision_msgs/ObjectHypothesis", class_id=box.name, score=box.score)
        result = ros.make("vision_msgs/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=pose)
        middle = ros.make("vision_msgs/Point2D", x=(box.x0 + box.x1) / 2, y=(box.y0 + box.y1) / 2)
        centre = ros.make("vision_msgs/Pose2D", position=middle, theta=0.0)
        size = {"size_x": box.x1 - box.x0, "size_y": box.y1 - box.y0}
        bbox = ros.make("vision_msgs/BoundingBox2D", center=centre, **size)
        items.append(
            ros.make("vision_msgs/Detection2D", header=header, results=[result], bbox=bbox, id=str(i))
        )
    return ros.make("vision_msgs/Detection2DArray", header=header, detections=items)


def _of_lidar(sweep: Sweep, sensor: SensorSpec) -> dict[str, np.ndarray]:
    assert isinstance(sensor.sheet, LidarSpec)
    points = dict(zip("xyz", sweep.xyz_m.T, strict=True))
    # Drivers of solid-state lidars call their lasers lines, and readers treat them as rings.
    laser = "ring" if sensor.sheet.pattern == "rows" else "line"
    return points | {"intensity": sweep.intensity, laser: sweep.ring, "time": sweep.time_s}


def _of_radar(scan: Scan, sensor: SensorSpec) -> dict[str, np.ndarray]:
    assert isinstance(sensor.sheet, RadarSpec)
    sign = np.float32(-1.0 if sensor.sheet.doppler_positive == "approaching" else 1.0)
    detections = dict(zip("xyz", scan.xyz_m.T, strict=True))
    return detections | {"doppler": sign * scan.range_rate_mps, "power": scan.power_db}


def _permuted(png: bytes, rng: np.random.Generator) -> bytes:
    """Labels with permuted classes, as from a model with another label set."""
    labels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    return encode_png(np.concatenate([rng.permutation(19), np.full(237, 255)]).astype(np.uint8)[labels])

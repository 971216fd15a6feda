"""Messages of a log for the measurements of one moment, faults included."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from pipeline.core.ros_messages import RosMessages
from pipeline.rig.topics import topics_of
from pipeline.simulate.faults import misread, swapped_with
from pipeline.simulate.sensors.data_sheets import LidarSpec, RadarSpec
from pipeline.simulate.sensors.lidar import Sweep
from pipeline.simulate.sensors.radar import Scan
from pipeline.simulate.sensors.rig_spec import SensorSpec, Sheet
from pipeline.simulate.sensors.semantics import Box, encode_png
from pipeline.simulate.sensors.simulated_frame import Image, Measurement, Setup

__all__ = ["Sent", "messages_of"]

Sent = tuple[int, str, Any]  # log time [ns], topic, message


def messages_of(
    messages: RosMessages,
    frame: Mapping[str, Measurement],
    stamps_ns: Mapping[str, int],
    setup: Setup,
    rng: np.random.Generator,
) -> list[Sent]:
    """The messages of one frame; a missing sensor has none."""
    sent: list[Sent] = []
    for sensor in setup.rig.sensors:
        name = sensor.name
        if name not in frame or setup.faults.has("missing", name):
            continue
        measured, stamp = frame[name], stamps_ns[name]
        if isinstance(measured, Image):
            sent += _of_camera(messages, measured, setup, sensor, stamp, rng)
        else:
            columns = _columns(measured, sensor.sheet)
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
    labels = _permuted(image.labels_png, rng) if today.has("labels", name) else image.labels_png
    header = messages.at(stamp, name)
    made = {
        "info": messages.camera_info(header, misread(sensor, today)),
        "image": messages.image(header, image.jpeg, "jpeg"),
        "labels": messages.image(header, labels, "mono8; png compressed"),
        "detections": _detections(messages, header, image.boxes),
    }
    topics = topics_of(name, "camera")
    return [(stamp, topics[what], message) for what, message in made.items()]


def _detections(ros: RosMessages, header: Any, boxes: list[Box]) -> Any:
    """Detection2DArray; boxes in full-image pixels."""
    pose, items = ros.pose(np.eye(4)), []
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


def _columns(measured: Sweep | Scan, sheet: Sheet) -> dict[str, np.ndarray]:
    """Columns of a point cloud."""
    columns = dict(zip("xyz", measured.xyz_m.T, strict=True))
    if isinstance(measured, Sweep):
        # Drivers of solid-state lidars call their lasers lines, and readers treat them as rings.
        laser = "line" if isinstance(sheet, LidarSpec) and sheet.pattern == "rosette" else "ring"
        return columns | {"intensity": measured.intensity, laser: measured.ring, "time": measured.time_s}
    is_turned = isinstance(sheet, RadarSpec) and sheet.doppler_positive == "approaching"
    rate = np.float32(-1.0 if is_turned else 1.0) * measured.range_rate_mps
    return columns | {"doppler": rate, "power": measured.power_db}


def _permuted(png: bytes, rng: np.random.Generator) -> bytes:
    """Labels with permuted classes, as from a model with another label set."""
    labels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    return encode_png(np.concatenate([rng.permutation(19), np.full(237, 255)]).astype(np.uint8)[labels])

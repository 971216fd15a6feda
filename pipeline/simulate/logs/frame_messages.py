"""What sensors deliver at one moment as messages of a log, the day's faults included."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from pipeline.rig.topics import topics_of
from pipeline.simulate.faults import DayFaults, misread, swapped_with
from pipeline.simulate.logs.messages import Messages
from pipeline.simulate.sensors.data_sheets import LidarSpec, RadarSpec
from pipeline.simulate.sensors.lidar import Sweep
from pipeline.simulate.sensors.mounting import Mounting
from pipeline.simulate.sensors.radar import Scan
from pipeline.simulate.sensors.rig_spec import RigSpec, SensorSpec
from pipeline.simulate.sensors.semantics import SemanticsSpec, encode_png
from pipeline.simulate.sensors.simulated_frame import Image, SimulatedFrame

__all__ = ["At", "Sent", "Setup", "messages_of"]

At = Callable[[float], int]  # stamp [ns] of a time of the drive [s]
Sent = tuple[int, str, Any]  # log time [ns], topic, message


@dataclass(frozen=True, eq=False)
class Setup:
    """A vehicle at one moment: its rig, where its sensors are, how well networks label, what is wrong with it."""

    rig: RigSpec
    mounting: Mounting
    semantics: SemanticsSpec
    faults: DayFaults = field(default_factory=DayFaults)


def messages_of(
    messages: Messages, frame: SimulatedFrame, setup: Setup, at: At, rng: np.random.Generator
) -> list[Sent]:
    """The messages of one frame; none of a sensor that is missing.

    Args:
        messages: makes them.
        frame: what the sensors deliver.
        setup: rig and faults of the day.
        at: stamp of a time of the drive.
        rng: exchanges classes where the day's labels are permuted.
    """
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
            # A reader takes the frame of a mistaken cable from the driver behind it.
            owner = plug if plug.kind == sensor.kind else sensor
            topic = topics_of(plug.name, plug.kind)["points"]
            sent.append((stamp, topic, messages.cloud(stamp, owner.name, columns)))
    return sent


def _plugged(sensor: SensorSpec, setup: Setup) -> SensorSpec:
    """The sensor on whose topic this one's points are sent."""
    for fault in setup.faults.faults:
        if fault.kind == "swap":
            one = setup.rig[fault.sensor]
            other = swapped_with(one, setup.rig)
            if other is not None and sensor in (one, other):
                return other if sensor == one else one
    return sensor


def _of_camera(
    messages: Messages,
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
    made = {
        "info": messages.camera_info(stamp, name, info),
        "image": messages.image(stamp, name, image.jpeg, "jpeg"),
        "labels": messages.image(stamp, name, labels, "mono8; png compressed"),
        "detections": messages.detections(stamp, name, image.boxes),
    }
    topics = topics_of(name, "camera")
    return [(stamp, topics[what], message) for what, message in made.items()]


def _of_lidar(sweep: Sweep, sensor: SensorSpec) -> dict[str, np.ndarray]:
    assert isinstance(sensor.sheet, LidarSpec)
    points = dict(zip("xyz", sweep.xyz_m.T, strict=True))
    # Drivers of solid-state lidars call their lasers lines, and readers take them for rings.
    laser = "ring" if sensor.sheet.pattern == "rows" else "line"
    return points | {"intensity": sweep.intensity, laser: sweep.ring, "time": sweep.time_s}


def _of_radar(scan: Scan, sensor: SensorSpec) -> dict[str, np.ndarray]:
    assert isinstance(sensor.sheet, RadarSpec)
    sign = np.float32(-1.0 if sensor.sheet.doppler_positive == "approaching" else 1.0)
    detections = dict(zip("xyz", scan.xyz_m.T, strict=True))
    return detections | {"doppler": sign * scan.range_rate_mps, "power": scan.power_db}


def _permuted(png: bytes, rng: np.random.Generator) -> bytes:
    """Labels with their classes exchanged (a model with another label set)."""
    labels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    return encode_png(np.concatenate([rng.permutation(19), np.full(237, 255)]).astype(np.uint8)[labels])

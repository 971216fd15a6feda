"""Conversion of simulated measurements to the messages of a log, faults included."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import Writer as Bag2Writer

from pipeline.core.ros_messages import McapLog, RosMessages
from pipeline.rig.se3 import from_rotation_translation
from pipeline.rig.topics import TOPICS, topics_of
from pipeline.simulate.faults import misread, swapped_with
from pipeline.simulate.sensors.lidar import Sweep
from pipeline.simulate.sensors.radar import Scan
from pipeline.simulate.sensors.rig_spec import LidarSpec, RadarSpec, RigSpec, SensorSpec, Sheet
from pipeline.simulate.sensors.semantics import Box, encode_png
from pipeline.simulate.sensors.simulated_frame import (
    Image,
    Measurement,
    Scene,
    Setup,
    frame_of,
    scene_of,
    triggered_stamps,
)
from pipeline.simulate.world.casting import Moment, World
from pipeline.simulate.world.drives import Drive, rotation

__all__ = [
    "FIRST_FRAME_S", "PARTIAL", "SUFFIXES", "Sent", "Ticks", "free_clocks", "messages_of", "open_log",
    "record_drive",
]  # fmt: skip

_ODOMETRY_HZ: Final = 20.0
FIRST_FRAME_S: Final = 1.0  # the log of a drive starts this long before its first frame
# For free-running sensors the log has the measurement nearest to the reference's sweep, because rendering
# dominates the cost; every few sweeps also the second nearest, so that pairing must choose.
_NEIGHBOURS_EVERY: Final = 4
_WAY_M, _TRIGGER_S = 3.0, 0.1  # between the two images of a pair; period of a camera that a lidar triggers
# Relative rate errors: mechanical lidars keep theirs to some parts in a thousand, quartzes to a hundred in a
# million. Without them, 30 and 10 Hz would keep a constant gap for a whole drive, as if triggered.
_RATE_SD: Final = {"camera": 1e-4, "lidar": 3e-3, "radar": 1e-4}
SUFFIXES: Final = {"mcap": ".mcap", "ros1": ".bag", "db3": ""}  # of a log's name, by container
PARTIAL: Final = ".partial-"  # a folder of this beginning holds a log that is being written


class OpenLog(NamedTuple):
    """A log open for writing: creates messages, and writes them with put(topic, stamp_ns, message)."""

    messages: RosMessages
    put: Callable[[str, int, Any], None]


@dataclass(frozen=True)
class Ticks:
    """The stamps of one sensor: phase + k period [s]."""

    period_s: float
    phase_s: float

    def nearest(self, t_s: float) -> tuple[float, float]:
        """The stamp nearest to a time, and the next nearest."""
        k = round((t_s - self.phase_s) / self.period_s)
        first = self.phase_s + k * self.period_s
        return first, first + float(np.copysign(self.period_s, t_s - first))


def record_drive(
    log: OpenLog, world: World, setups: Sequence[Setup], rate_hz: float, rng: np.random.Generator,
    tick: Callable[[int], None],
) -> None:  # fmt: skip
    """Write one drive to an open log; `setups` has the vehicle's state at each moment to write."""
    drive, messages, rig = world.drive, log.messages, setups[0].rig

    def at(t_s: float) -> int:
        return drive.start_ns + round(t_s * 1e9)

    odometry = _odometry(drive, rng)
    log.put(TOPICS["tf"], at(0.0), messages.sensor_poses(at(0.0), setups[0].mounting.nominal()))
    scene, sweep_s = scene_of(drive), getattr(rig.reference.sheet, "sweep_s", 0.0)
    clocks = free_clocks(rig, np.random.default_rng([drive.seed, 53]))
    first: dict[str, Measurement] = {}
    for k, setup in enumerate(setups):
        stamp = FIRST_FRAME_S + k / rate_hz + rng.uniform(0, 0.02)
        if rig.reference.name in clocks:
            stamp = clocks[rig.reference.name].nearest(stamp)[0]
        moment = world.moment(stamp - sweep_s / 2)
        near, next_near = _stamps(setup, clocks, stamp, rng)
        alone = [{n: t} for n, t in next_near.items()] if k % _NEIGHBOURS_EVERY == 0 else []
        pending: list[Sent] = []
        for group in ([near], alone):
            frames = [frame_of(moment, scene, setup, stamps, rng) for stamps in group]
            for stamps, frame in zip(group, frames, strict=True):
                first = frame | first
                shown = {n: first[n] if setup.faults.has("stuck", n) else m for n, m in frame.items()}
                stamps_ns = {n: at(t) for n, t in stamps.items()}
                pending += messages_of(messages, shown, stamps_ns, setup, rng)
        if rig.image_pairs:
            pending += _images_before(messages, moment, scene, setup, clocks, near, rate_hz, at)
        while odometry and odometry[0][0] <= stamp + 0.1:
            t, T, speed, yaw_rate = odometry.pop(0)
            pending.append((at(t), TOPICS["odometry"], messages.odometry(at(t), T, speed, yaw_rate)))
        for time_ns, topic, message in sorted(pending, key=lambda p: p[0]):
            log.put(topic, time_ns, message)
        tick(k + 1)


def _images_before(
    messages: RosMessages, moment: Moment, scene: Scene, setup: Setup, clocks: Mapping[str, Ticks],
    stamps_s: Mapping[str, float], rate_hz: float, at: Callable[[float], int],
) -> list[Sent]:  # fmt: skip
    """Of each camera the image at its own rate some metres before, where the last moment lies farther back.

    Its draws are its own: the moment's are those of a rig without such images.
    """
    sent: list[Sent] = []
    speed = float(np.linalg.norm(scene.ego.velocities(np.array([moment.t_s]))[0]))
    if speed / rate_hz < _WAY_M * 1.3:
        return sent
    for name in (s.name for s in setup.rig.of_kind("camera")):
        if setup.faults.has("missing", name) or setup.faults.has("stuck", name):
            continue
        period_s = clocks[name].period_s if name in clocks else _TRIGGER_S
        stamp_s = stamps_s[name] - period_s * max(1, round(_WAY_M / speed / period_s))
        rng = np.random.default_rng([round(stamp_s * 1e6), 67])
        image = frame_of(moment, scene, setup, {name: stamp_s}, rng)[name]
        assert isinstance(image, Image)
        jpeg = messages.image(messages.at(at(stamp_s), name), image.jpeg, "jpeg")
        sent.append((at(stamp_s), topics_of(name, "camera")["image"], jpeg))
    return sent


def _stamps(
    setup: Setup, clocks: Mapping[str, Ticks], sweep_s: float, rng: np.random.Generator
) -> tuple[dict[str, float], dict[str, float]]:
    """By sensor, the stamp nearest to the reference's; for free-running sensors also the second nearest."""
    rig, mounting = setup.rig, setup.mounting
    if not clocks:
        return triggered_stamps(rig, mounting, sweep_s, rng), {}
    phase = {n: mounting[n].phase_s for n in clocks}
    near = {n: ticks.nearest(sweep_s) for n, ticks in clocks.items()}
    others = {n: second + phase[n] for n, (_, second) in near.items() if n != rig.reference.name}
    return {n: first + phase[n] for n, (first, _) in near.items()}, others


def _odometry(drive: Drive, rng: np.random.Generator) -> list[tuple[float, np.ndarray, float, float]]:
    """Dead reckoning from wheels and a gyro: (time, T_odom_vehicle, speed, yaw rate)."""
    t = np.arange(0.0, drive.duration_s, 1 / _ODOMETRY_HZ)
    T = drive.ego.poses(t)
    velocity, omega = drive.ego.velocities(t)
    speed = np.einsum("ij,ij->i", velocity, T[:, :3, 0]) * (1 + rng.normal(0, 0.004))
    speed += rng.normal(0, 0.03, len(t))
    yaw_rate = np.einsum("ij,ij->i", omega, T[:, :3, 2]) + rng.normal(0, 5e-4) + rng.normal(0, 0.002, len(t))
    yaw = np.cumsum(yaw_rate) / _ODOMETRY_HZ
    x, y = np.cumsum(speed * np.cos(yaw)) / _ODOMETRY_HZ, np.cumsum(speed * np.sin(yaw)) / _ODOMETRY_HZ
    R = rotation(yaw, np.zeros_like(yaw), np.zeros_like(yaw))
    poses = from_rotation_translation(R, np.stack([x, y, np.zeros_like(x)], 1))
    return [(float(a), b, float(c), float(d)) for a, b, c, d in zip(t, poses, speed, yaw_rate, strict=True)]


def free_clocks(rig: RigSpec, rng: np.random.Generator) -> dict[str, Ticks]:
    """Independent clocks of the free-running sensors for one drive: random phases and rate errors."""
    free = {s.name: (s.rate_hz, _RATE_SD[s.kind]) for s in rig.sensors if s.rate_hz is not None}
    rates, sd = np.array([*free.values()]).reshape(-1, 2).T
    periods = 1 / (rates * (1 + rng.normal(0, sd)))
    phases = rng.uniform(0, periods)
    return {n: Ticks(float(p), float(a)) for n, p, a in zip(free, periods, phases, strict=True)}


@contextmanager
def open_log(path: Path, container: str) -> Iterator[OpenLog]:
    """Open a log; it gets its final name, replacing an old one, when the block ends without an error."""
    partial = path.parent / f"{PARTIAL}{path.name}"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    opener = {"mcap": _mcap, "ros1": _ros1, "db3": _db3}[container]
    try:
        with opener(partial / path.name) as log:
            yield log
        if path.is_dir():
            shutil.rmtree(path)
        (partial / path.name).replace(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def _mcap(path: Path) -> Iterator[OpenLog]:
    with path.open("wb") as file:
        log = McapLog(file, "boresight-simulate")
        yield OpenLog(log.messages, log.put)
        log.writer.finish()


def _ros1(path: Path) -> AbstractContextManager[OpenLog]:
    writer = Bag1Writer(path)
    writer.set_compression(Bag1Writer.CompressionFormat.LZ4)
    return _bag(writer, RosMessages(1), latched={TOPICS["tf"]: {"latching": 1}})


def _db3(path: Path) -> AbstractContextManager[OpenLog]:
    return _bag(Bag2Writer(path, version=9), RosMessages(2), latched={})


@contextmanager
def _bag(writer: Any, messages: RosMessages, latched: dict[str, dict[str, int]]) -> Iterator[OpenLog]:
    connections: dict[str, Any] = {}
    with writer:

        def put(topic: str, stamp_ns: int, message: Any) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, message.__msgtype__, typestore=messages.typestore, **latched.get(topic, {})
                )
            writer.write(connections[topic], stamp_ns, messages.serialised(message))

        yield OpenLog(messages, put)


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
    messages: RosMessages, image: Image, setup: Setup, sensor: SensorSpec, stamp: int,
    rng: np.random.Generator,
) -> list[Sent]:  # fmt: skip
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

"""Turns what the sensors deliver into the messages of a log, day faults included."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import cv2
import numpy as np

from pipeline.geometry.se3 import from_rotation_translation
from pipeline.simulate.faults import DayFaults, misread
from pipeline.simulate.logs.messages import Messages
from pipeline.simulate.logs.writers import TOPICS, OpenLog
from pipeline.simulate.sensors.clocks import Clocks, free_clocks
from pipeline.simulate.sensors.radar import Scan
from pipeline.simulate.sensors.rigs import Mounting, RigSpec
from pipeline.simulate.sensors.semantics import SemanticsSpec, encode_png
from pipeline.simulate.sensors.simulated_frame import (
    Image,
    SimulatedFrame,
    frame_of,
    image_of,
    scan_of,
    scene_of,
)
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive

__all__ = ["FIRST_FRAME_S", "Setup", "nominal_poses", "record_drive", "trio"]

_ODOMETRY_HZ: Final = 20.0
FIRST_FRAME_S: Final = 1.0  # a drive's log begins this long before its first frame
# Of free-running sensors the log holds the image and the scan next to each sweep, for rendering costs most of a day;
# with every so many sweeps also the second next ones, so that pairing has to choose.
_NEIGHBOURS_EVERY: Final = 4


@dataclass(frozen=True, eq=False)
class Setup:
    """A vehicle on one day: its rig, where its sensors are in the morning, how well networks label, what is wrong."""

    rig: RigSpec
    mounting: Mounting
    semantics: SemanticsSpec
    faults: DayFaults = field(default_factory=DayFaults)


def record_drive(
    log: OpenLog,
    world: World,
    setup: Setup,
    mountings: Sequence[Mounting],
    rate_hz: float,
    rng: np.random.Generator,
    tick: Callable[[int], None],
) -> None:
    """Write one drive.

    Args:
        log: open for writing.
        world: of the drive.
        setup: the vehicle that drives through it.
        mountings: where the sensors are at each trio to write.
        rate_hz: trios per second.
        rng: noise.
        tick: told the number of frames written, after each.
    """
    drive, messages = world.drive, log.messages

    def at(t_s: float) -> int:
        return drive.start_ns + round(t_s * 1e9)

    odometry = _odometry(drive, rng)
    log.put(TOPICS["tf"], at(0.0), messages.transforms(at(0.0), nominal_poses(setup.mounting)))
    scene = scene_of(drive)
    semantics = _labelled_in_the_dark(setup.semantics, setup.faults)
    free_hz = setup.rig.free_hz
    clocks = None if free_hz is None else free_clocks(free_hz, np.random.default_rng([drive.seed, 53]))
    for k, mounting in enumerate(mountings):
        stamp = FIRST_FRAME_S + k / rate_hz + rng.uniform(0, 0.02)
        stamp, near = (stamp, None) if clocks is None else _free_stamps(clocks, stamp)
        moment = world.moment(stamp - setup.rig.lidar.sweep_s / 2)
        view = moment, scene, setup.rig, mounting
        frame = frame_of(*view, stamp, rng, semantics, near and near[0])
        pending = trio(messages, frame, setup, at, rng)
        if near is not None and k % _NEIGHBOURS_EVERY == 0:
            image, scan = image_of(*view, near[1][0], rng, semantics), scan_of(*view, near[1][1], rng)
            pending += _of_camera(messages, image, setup, at, rng)
            pending += _of_radar(messages, scan, near[1][1], setup, at)
        while odometry and odometry[0][0] <= stamp + 0.1:
            t, T, speed, yaw_rate = odometry.pop(0)
            pending.append((at(t), TOPICS["odometry"], messages.odometry(at(t), T, speed, yaw_rate)))
        for time_ns, topic, message in sorted(pending, key=lambda p: p[0]):
            log.put(topic, time_ns, message)
        tick(k + 1)


def _free_stamps(
    clocks: Clocks, about_s: float
) -> tuple[float, tuple[tuple[float, float], tuple[float, float]]]:
    """The sweep nearest to a time, the (image, scan) nearest to it, and the next nearest."""
    stamp = clocks.lidar.nearest(about_s)[0]
    camera, radar = clocks.camera.nearest(stamp), clocks.radar.nearest(stamp)
    return stamp, ((camera[0], radar[0]), (camera[1], radar[1]))


def trio(
    messages: Messages,
    frame: SimulatedFrame,
    setup: Setup,
    at: Callable[[float], int],
    rng: np.random.Generator,
) -> list[tuple[int, str, Any]]:
    """The messages of one frame: (log time [ns], topic, message).

    Args:
        messages: makes them.
        frame: what the sensors deliver.
        setup: rig and faults of the day.
        at: stamp [ns] of a time of the drive [s].
        rng: exchanges classes where the day's labels are permuted.
    """
    image = Image(frame.camera_stamp_s, frame.jpeg, frame.labels_png, frame.boxes, frame.true_labels)
    return [
        *_of_camera(messages, image, setup, at, rng),
        *_of_lidar(messages, frame, setup, at),
        *_of_radar(messages, frame.scan, frame.radar_stamp_s, setup, at),
    ]


def _of_camera(
    messages: Messages,
    image: Image,
    setup: Setup,
    at: Callable[[float], int],
    rng: np.random.Generator,
) -> list[tuple[int, str, Any]]:
    """An image with its intrinsics, labels and detections; none where the camera is missing."""
    today, stamp = setup.faults, at(image.stamp_s)
    if "camera" in today.missing:
        return []
    info = misread(setup.mounting.nominal_camera, today)
    labels = _permuted(image.labels_png, rng) if today.labels_permuted else image.labels_png
    return [
        (stamp, TOPICS["info"], messages.camera_info(stamp, info)),
        (stamp, TOPICS["image"], messages.image(stamp, image.jpeg, "jpeg")),
        (stamp, TOPICS["labels"], messages.image(stamp, labels, "mono8; png compressed")),
        (stamp, TOPICS["detections"], messages.detections(stamp, image.boxes)),
    ]


def _of_lidar(
    messages: Messages, frame: SimulatedFrame, setup: Setup, at: Callable[[float], int]
) -> list[tuple[int, str, Any]]:
    stamp, sweep = at(frame.lidar_stamp_s), frame.sweep
    if "lidar" in setup.faults.missing:
        return []
    points = dict(zip("xyz", sweep.xyz_m.T, strict=True))
    # Drivers of solid-state lidars call their lasers lines, and readers take them for rings.
    laser = "ring" if setup.rig.lidar.pattern == "rows" else "line"
    points |= {"intensity": sweep.intensity, laser: sweep.ring, "time": sweep.time_s}
    topic = TOPICS["radar" if setup.faults.swapped else "lidar"]
    return [(stamp, topic, messages.cloud(stamp, "lidar", points))]


def _of_radar(
    messages: Messages, scan: Scan, stamp_s: float, setup: Setup, at: Callable[[float], int]
) -> list[tuple[int, str, Any]]:
    stamp = at(stamp_s)
    if "radar" in setup.faults.missing:
        return []
    sign = np.float32(-1.0 if setup.rig.radar.doppler_positive == "approaching" else 1.0)
    detections = dict(zip("xyz", scan.xyz_m.T, strict=True))
    detections |= {"doppler": sign * scan.range_rate_mps, "power": scan.power_db}
    topic = TOPICS["lidar" if setup.faults.swapped else "radar"]
    return [(stamp, topic, messages.cloud(stamp, "radar", detections))]


def nominal_poses(mounting: Mounting) -> dict[str, np.ndarray]:
    """T_vehicle_sensor as /tf_static says."""
    return {
        "camera": mounting.T_vehicle_nominal_camera,
        "lidar": mounting.T_vehicle_nominal_lidar,
        "radar": mounting.T_vehicle_nominal_radar,
    }


def _permuted(png: bytes, rng: np.random.Generator) -> bytes:
    """Labels with their classes exchanged (a model with another label set)."""
    labels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    return encode_png(np.concatenate([rng.permutation(19), np.full(237, 255)]).astype(np.uint8)[labels])


def _labelled_in_the_dark(spec: SemanticsSpec, today: DayFaults) -> SemanticsSpec:
    """What networks that learned by day make of the night: outlines three times as loose, half of the boxes missed.

    Or of dusk: outlines 2 label pixels looser, half of the boxes missed, and what is seen is told as by day.
    """
    if today.dusk:
        return replace(spec, boundary_px=spec.boundary_px + 2.0, miss=0.5)
    if not today.night:
        return spec
    return replace(
        spec,
        boundary_px=3 * spec.boundary_px,
        confusion=0.35,
        miss=0.5,
        box_jitter=3 * spec.box_jitter,
        false_boxes=3 * spec.false_boxes,
    )


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
    R = np.zeros((len(t), 3, 3))
    R[:, 0, 0], R[:, 0, 1] = np.cos(yaw), -np.sin(yaw)
    R[:, 1, 0], R[:, 1, 1], R[:, 2, 2] = np.sin(yaw), np.cos(yaw), 1.0
    poses = from_rotation_translation(R, np.stack([x, y, np.zeros_like(x)], 1))
    return [(float(a), b, float(c), float(d)) for a, b, c, d in zip(t, poses, speed, yaw_rate, strict=True)]

"""Measurements of all sensors at one moment of the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.rig.graph import Kind
from pipeline.simulate.faults import DayFaults
from pipeline.simulate.sensors.camera import RollingShutter, encode_jpeg, render, view_of
from pipeline.simulate.sensors.lidar import Sweep, sweep_lidar
from pipeline.simulate.sensors.mounting import Mounting
from pipeline.simulate.sensors.radar import Scan, scan_radar
from pipeline.simulate.sensors.rig_spec import CameraSpec, LidarSpec, RigSpec, SensorSpec
from pipeline.simulate.sensors.semantics import (
    Box,
    SemanticsSpec,
    boxes_of,
    encode_png,
    label_image,
    noisy_boxes,
    noisy_labels,
)
from pipeline.simulate.world.casting import Moment
from pipeline.simulate.world.drives import Drive, Motion

__all__ = ["Image", "Measurement", "Scene", "Setup", "frame_of", "scene_of", "triggered_stamps"]

_DRAWN: tuple[Kind, ...] = ("lidar", "camera", "radar")


@dataclass(frozen=True, eq=False)
class Image:
    """An image with the outputs of networks; `true_labels` is not logged."""

    jpeg: bytes
    boxes: list[Box]
    true_labels: np.ndarray = field(repr=False)
    labels_png: bytes = b""


Measurement = Image | Sweep | Scan


@dataclass(frozen=True, eq=False)
class Scene:
    """Surroundings of a vehicle other than meshes: ego motion, light, radar mirrors and strong reflectors."""

    ego: Motion
    sun: np.ndarray
    night: bool = False
    mirrors_m: tuple[float, ...] = ()
    beacons_map: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Setup:
    """A vehicle at one moment: rig, mounting, label networks, faults."""

    rig: RigSpec
    mounting: Mounting
    semantics: SemanticsSpec = field(default_factory=SemanticsSpec)
    faults: DayFaults = field(default_factory=DayFaults)


def scene_of(drive: Drive) -> Scene:
    """Scene of a drive; rails (highway) and house fronts (urban) are radar mirrors."""
    layout = drive.layout
    right = -layout.edge - 0.8 - layout.lanes_own[0]
    mirrors = (right, -layout.lanes_own[0]) if drive.landscape.fast else (right - 3.0,)
    return Scene(drive.ego, drive.sun, drive.night, mirrors)


def frame_of(
    moment: Moment, scene: Scene, setup: Setup, stamps_s: Mapping[str, float], rng: np.random.Generator
) -> dict[str, Measurement]:
    """Measurements of the named sensors with these stamps; a sensor measures earlier than its stamp by its delay.

    The moment should be near the middle of the reference lidar's sweep. The order of random draws defines a
    day: lidars, then camera images, radars, and last the networks' labels.
    """
    sensors = [s for kind in _DRAWN for s in setup.rig.of_kind(kind) if s.name in stamps_s]
    found = {s.name: _measured(moment, scene, setup, s, stamps_s[s.name], rng) for s in sensors}
    for name, image in found.items():
        if isinstance(image, Image):
            labels = noisy_labels(image.true_labels, setup.semantics, rng)
            found[name] = replace(image, labels_png=encode_png(labels))
    return found


def triggered_stamps(
    rig: RigSpec, mounting: Mounting, stamp_s: float, rng: np.random.Generator
) -> dict[str, float]:
    """Stamps of all sensors triggered by the reference lidar's sweep, and of the lidar itself."""
    others = [s for s in rig.sensors if s != rig.reference]
    jitter = np.clip(rng.normal(0, rig.sync_jitter_s, len(others)), -0.0045, 0.0045)
    stamps = stamp_s + jitter
    found = {s.name: float(t) + mounting[s.name].phase_s for s, t in zip(others, stamps, strict=True)}
    return found | {rig.reference.name: stamp_s}


def _measured(
    moment: Moment, scene: Scene, setup: Setup, sensor: SensorSpec, stamp_s: float, rng: np.random.Generator
) -> Measurement:
    """Measurement of one sensor; labels of an image are missing."""
    sheet, mounted = sensor.sheet, setup.mounting[sensor.name]
    T, at_s = mounted.T_vehicle, stamp_s - mounted.delay_s
    if isinstance(sheet, LidarSpec):
        return sweep_lidar(moment, scene.ego, T, sheet, at_s, rng)
    moment = moment.advanced(at_s)
    if not isinstance(sheet, CameraSpec):
        return scan_radar(
            moment, scene.ego, T, sheet, mounted.errors, rng, scene.mirrors_m, scene.beacons_map
        )
    camera = setup.mounting.camera(sensor.name)
    T_map_camera = scene.ego.poses(np.array([at_s]))[0] @ T
    shutter = RollingShutter(scene.ego, T, sheet.readout_s) if sheet.readout_s else None
    view = view_of(moment, camera, T_map_camera, shutter)
    image = render(moment, view, scene.sun, rng, night=scene.night)
    size_px = (camera.width_px, camera.height_px)
    boxes = noisy_boxes(boxes_of(moment, view.coarse), size_px, setup.semantics, rng)
    return Image(encode_jpeg(image, sheet.jpeg_quality), boxes, label_image(moment, view.coarse))

"""Measurements of all sensors at one moment of the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pipeline.rig.graph import Kind
from pipeline.simulate.sensors.camera import RollingShutter, encode_jpeg, render, view_of
from pipeline.simulate.sensors.data_sheets import CameraSpec, LidarSpec, RadarSpec
from pipeline.simulate.sensors.lidar import Sweep, sweep_lidar
from pipeline.simulate.sensors.mounting import Mounting
from pipeline.simulate.sensors.radar import Scan, scan_radar
from pipeline.simulate.sensors.rig_spec import RigSpec
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

__all__ = ["Image", "Scene", "Seat", "SimulatedFrame", "frame_of", "scene_of", "triggered_stamps"]


@dataclass(frozen=True, eq=False)
class Image:
    """An image with the outputs of networks; `true_labels` is not logged."""

    jpeg: bytes
    labels_png: bytes
    boxes: list[Box]
    true_labels: np.ndarray = field(repr=False)


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """Measurements of the sensors at one moment, by name; stamps in seconds of the drive."""

    stamps_s: Mapping[str, float]
    images: Mapping[str, Image]
    sweeps: Mapping[str, Sweep]
    scans: Mapping[str, Scan]


@dataclass(frozen=True, eq=False)
class Scene:
    """Surroundings of a vehicle other than meshes: ego motion, light, radar mirrors and strong reflectors."""

    ego: Motion
    sun: np.ndarray
    night: bool = False
    mirrors_m: tuple[float, ...] = ()
    beacons_map: np.ndarray | None = None


def scene_of(drive: Drive) -> Scene:
    """Scene of a drive; rails (highway) and house fronts (urban) are radar mirrors."""
    layout = drive.layout
    right = layout.right_edge - 0.8 - layout.lanes_own[0]
    mirrors = (right, -layout.lanes_own[0]) if drive.landscape.fast else (right - 3.0,)
    return Scene(drive.ego, drive.sun, drive.night, mirrors)


@dataclass(frozen=True, eq=False)
class Seat:
    """Inputs of one moment: world at that time, surroundings, and the vehicle's sensors."""

    moment: Moment
    scene: Scene
    rig: RigSpec
    mounting: Mounting


def frame_of(
    seat: Seat, stamps_s: Mapping[str, float], rng: np.random.Generator, semantics: SemanticsSpec
) -> SimulatedFrame:
    """Measurements of the named sensors with these stamps; a sensor measures earlier than its stamp by its delay.

    The moment should be near the middle of the reference lidar's sweep. The order of random draws defines a
    day: lidars, then camera images, radars, and last the networks' outputs.
    """

    def at(kind: Kind) -> dict[str, float]:
        return {s.name: stamps_s[s.name] for s in seat.rig.of_kind(kind) if s.name in stamps_s}

    sweeps = {n: _sweep(seat, n, t, rng) for n, t in at("lidar").items()}
    exposed = {n: _exposed(seat, n, t, rng, semantics) for n, t in at("camera").items()}
    scans = {n: _scan(seat, n, t, rng) for n, t in at("radar").items()}
    images = {
        n: Image(jpeg, encode_png(noisy_labels(true, semantics, rng)), boxes, true)
        for n, (jpeg, true, boxes) in exposed.items()
    }
    return SimulatedFrame(dict(stamps_s), images, sweeps, scans)


def triggered_stamps(
    rig: RigSpec, mounting: Mounting, stamp_s: float, rng: np.random.Generator
) -> dict[str, float]:
    """Stamps of all sensors triggered by the reference lidar's sweep, and of the lidar itself."""
    others = [s for s in rig.sensors if s != rig.reference]
    jitter = np.clip(rng.normal(0, rig.sync_jitter_s, len(others)), -0.0045, 0.0045)
    stamps = stamp_s + jitter
    found = {s.name: float(t) + mounting[s.name].phase_s for s, t in zip(others, stamps, strict=True)}
    return found | {rig.reference.name: stamp_s}


def _sweep(seat: Seat, name: str, stamp_s: float, rng: np.random.Generator) -> Sweep:
    sheet, mounted = seat.rig[name].sheet, seat.mounting[name]
    assert isinstance(sheet, LidarSpec)
    end_s = stamp_s - mounted.delay_s
    return sweep_lidar(seat.moment, seat.scene.ego, mounted.T_vehicle, sheet, end_s, rng)


def _scan(seat: Seat, name: str, stamp_s: float, rng: np.random.Generator) -> Scan:
    sheet, mounted, scene = seat.rig[name].sheet, seat.mounting[name], seat.scene
    assert isinstance(sheet, RadarSpec)
    assert mounted.errors is not None
    moment = seat.moment.advanced(stamp_s - mounted.delay_s)
    return scan_radar(
        moment, scene.ego, mounted.T_vehicle, sheet, mounted.errors, rng, scene.mirrors_m, scene.beacons_map
    )


def _exposed(
    seat: Seat, name: str, stamp_s: float, rng: np.random.Generator, semantics: SemanticsSpec
) -> tuple[bytes, np.ndarray, list[Box]]:
    """JPEG, true labels and noisy boxes of the image with a stamp."""
    sheet, mounted, scene = seat.rig[name].sheet, seat.mounting[name], seat.scene
    assert isinstance(sheet, CameraSpec)
    camera, _ = seat.mounting.camera(name)
    exposure = seat.moment.advanced(stamp_s - mounted.delay_s)
    T_map_camera = scene.ego.poses(np.array([exposure.t_s]))[0] @ mounted.T_vehicle
    shutter = RollingShutter(scene.ego, mounted.T_vehicle, sheet.readout_s) if sheet.readout_s else None
    view = view_of(exposure, camera, T_map_camera, shutter)
    image = render(exposure, view, scene.sun, rng, night=scene.night)
    true = label_image(exposure, view.coarse)
    size_px = (camera.width_px, camera.height_px)
    boxes = noisy_boxes(boxes_of(exposure, view.coarse), size_px, semantics, rng)
    return encode_jpeg(image, sheet.jpeg_quality), true, boxes

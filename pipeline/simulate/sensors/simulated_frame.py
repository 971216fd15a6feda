"""One trio, from the world to what the sensors deliver."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.simulate.sensors.camera import encode_jpeg, render, view_of
from pipeline.simulate.sensors.lidar import Sweep, sweep_lidar
from pipeline.simulate.sensors.radar import RadarErrors, Scan, scan_radar
from pipeline.simulate.sensors.rigs import Mounting, RigSpec
from pipeline.simulate.sensors.rolling_shutter import RollingShutter
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

__all__ = ["Image", "Scene", "SimulatedFrame", "frame_of", "image_of", "scan_of", "scene_of"]


@dataclass(frozen=True, eq=False)
class Image:
    """An image and what networks make of it; `true_labels` goes into no log."""

    stamp_s: float
    jpeg: bytes
    labels_png: bytes
    boxes: list[Box]
    true_labels: np.ndarray = field(repr=False)


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """What the sensors deliver for one trio, stamps in seconds of the drive; `true_labels` goes into no log."""

    lidar_stamp_s: float
    camera_stamp_s: float
    radar_stamp_s: float
    jpeg: bytes
    labels_png: bytes
    boxes: list[Box]
    sweep: Sweep
    scan: Scan
    true_labels: np.ndarray = field(repr=False)


@dataclass(frozen=True, eq=False)
class Scene:
    """What is around a vehicle, beside meshes: its motion, the light, and what mirrors or outshines for the radar."""

    ego: Motion
    sun: np.ndarray
    night: bool = False
    mirrors_m: tuple[float, ...] = ()
    beacons_map: np.ndarray | None = None


def scene_of(drive: Drive) -> Scene:
    """Scene of a drive; rails (highway) and house fronts (urban) mirror."""
    layout = drive.layout
    right = layout.right_edge - 0.8 - layout.lanes_own[0]
    mirrors = (right, -layout.lanes_own[0]) if drive.environment == "highway" else (right - 3.0,)
    return Scene(drive.ego, drive.sun, drive.night, mirrors)


def frame_of(
    moment: Moment,
    scene: Scene,
    rig: RigSpec,
    mounting: Mounting,
    stamp_s: float,
    rng: np.random.Generator,
    semantics: SemanticsSpec,
    stamps_s: tuple[float, float] | None = None,
) -> SimulatedFrame:
    """The trio whose lidar sweep ends at `stamp_s`; `moment` should be near the middle of the sweep.

    `stamps_s` are those of image and scan; None = the sweep triggers both.
    """
    camera_stamp, radar_stamp = stamps_s or _triggered(rig, mounting, stamp_s, rng)
    sweep = sweep_lidar(moment, scene.ego, mounting.T_vehicle_lidar, rig.lidar, stamp_s, rng)
    jpeg, true, boxes = _exposed(moment, scene, rig, mounting, camera_stamp, rng, semantics)
    scan = scan_of(moment, scene, rig, mounting, radar_stamp, rng)
    labels = encode_png(noisy_labels(true, semantics, rng))
    return SimulatedFrame(stamp_s, camera_stamp, radar_stamp, jpeg, labels, boxes, sweep, scan, true)


def image_of(
    moment: Moment,
    scene: Scene,
    rig: RigSpec,
    mounting: Mounting,
    stamp_s: float,
    rng: np.random.Generator,
    semantics: SemanticsSpec,
) -> Image:
    """The image with a stamp, taken the camera's delay before it."""
    jpeg, true, boxes = _exposed(moment, scene, rig, mounting, stamp_s, rng, semantics)
    return Image(stamp_s, jpeg, encode_png(noisy_labels(true, semantics, rng)), boxes, true)


def scan_of(
    moment: Moment, scene: Scene, rig: RigSpec, mounting: Mounting, stamp_s: float, rng: np.random.Generator
) -> Scan:
    """The radar scan with a stamp, taken the radar's delay before it."""
    errors = RadarErrors(mounting.radar_range_bias_m, mounting.radar_elevation_bias_rad)
    return scan_radar(
        moment.advanced(stamp_s - mounting.radar_delay_s),
        scene.ego,
        mounting.T_vehicle_radar,
        rig.radar,
        errors,
        rng,
        scene.mirrors_m,
        scene.beacons_map,
    )


def _triggered(
    rig: RigSpec, mounting: Mounting, stamp_s: float, rng: np.random.Generator
) -> tuple[float, float]:
    """Stamps of image and scan that a sweep triggers."""
    camera, radar = stamp_s + np.clip(rng.normal(0, rig.sync_jitter_s, 2), -0.0045, 0.0045)
    return float(camera) + mounting.camera_phase_s, float(radar) + mounting.radar_phase_s


def _exposed(
    moment: Moment,
    scene: Scene,
    rig: RigSpec,
    mounting: Mounting,
    stamp_s: float,
    rng: np.random.Generator,
    semantics: SemanticsSpec,
) -> tuple[bytes, np.ndarray, list[Box]]:
    """JPEG, true labels and noisy boxes of the image with a stamp."""
    exposure = moment.advanced(stamp_s - mounting.camera_delay_s)
    T_map_camera = scene.ego.poses(np.array([exposure.t_s]))[0] @ mounting.T_vehicle_camera
    readout_s = rig.camera.readout_s
    shutter = RollingShutter(scene.ego, mounting.T_vehicle_camera, readout_s) if readout_s else None
    view = view_of(exposure, mounting.camera, T_map_camera, shutter)
    image = render(exposure, view, scene.sun, rng, night=scene.night)
    true = label_image(exposure, view.coarse)
    size_px = (mounting.camera.width_px, mounting.camera.height_px)
    boxes = noisy_boxes(boxes_of(exposure, view.coarse), size_px, semantics, rng)
    return encode_jpeg(image, rig.camera.jpeg_quality), true, boxes

"""One synchronised trio of a drive, from the world to what the sensors deliver."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.simulate.camera import encode_jpeg, render, view_of
from pipeline.simulate.casting import World
from pipeline.simulate.lidar import Sweep, sweep_lidar
from pipeline.simulate.radar import RadarErrors, Scan, scan_radar
from pipeline.simulate.rigs import Mounting, RigSpec
from pipeline.simulate.semantics import (
    Box,
    SemanticsSpec,
    boxes_of,
    encode_png,
    label_image,
    noisy_boxes,
    noisy_labels,
)

__all__ = ["SimulatedFrame", "frame_at"]


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


def frame_at(
    world: World,
    rig: RigSpec,
    mounting: Mounting,
    stamp_s: float,
    rng: np.random.Generator,
    semantics: SemanticsSpec = SemanticsSpec(),  # noqa: B008  frozen
) -> SimulatedFrame:
    """The trio whose lidar sweep ends at `stamp_s`."""
    drive = world.drive
    camera_stamp, radar_stamp = stamp_s + np.clip(rng.normal(0, rig.sync_jitter_s, 2), -0.0045, 0.0045)
    sweep_moment = world.moment(stamp_s - rig.lidar.sweep_s / 2)
    sweep = sweep_lidar(sweep_moment, drive.ego, mounting.T_vehicle_lidar, rig.lidar, stamp_s, rng)
    exposure = sweep_moment.advanced(float(camera_stamp - mounting.camera_delay_s))
    T_map_camera = drive.ego.poses(np.array([exposure.t_s]))[0] @ mounting.T_vehicle_camera
    view = view_of(exposure, mounting.camera, T_map_camera)
    image = render(exposure, view, drive.sun, rng, night=drive.night)
    true = label_image(exposure, view.coarse)
    boxes = noisy_boxes(
        boxes_of(exposure, view.coarse), (mounting.camera.width_px, mounting.camera.height_px), semantics, rng
    )
    scan_moment = sweep_moment.advanced(float(radar_stamp - mounting.radar_delay_s))
    errors = RadarErrors(mounting.radar_range_bias_m, mounting.radar_elevation_bias_rad)
    scan = scan_radar(scan_moment, drive, mounting.T_vehicle_radar, rig.radar, errors, rng)
    return SimulatedFrame(
        stamp_s, float(camera_stamp), float(radar_stamp), encode_jpeg(image, rig.camera.jpeg_quality),
        encode_png(noisy_labels(true, semantics, rng)), boxes, sweep, scan, true,
    )  # fmt: skip

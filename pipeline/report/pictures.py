"""The pictures of one vehicle-day: chosen frames, drawn and encoded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.report.above import top_view
from pipeline.report.encode import jpeg_uri
from pipeline.report.overlays import Extrinsics, Scene, close_up, front_view
from pipeline.report.scenes import choose_windows
from pipeline.rig.cameras import camera_of
from schemas.calibrations import SENSORS

__all__ = ["CloseUps", "ScenePictures", "close_ups_of", "scene_pictures"]

_CLOSE_UPS = 3
_CLOSE_UP_WIDTH_PX = 420


@dataclass(frozen=True)
class CloseUps:
    """The same windows before and after, as data URIs."""

    pairs: list[tuple[str, str]]
    zoom: int
    window_deg: str


@dataclass(frozen=True)
class ScenePictures:
    """One frame on the page; pictures as data URIs, empty if the frame lacks a sensor that they need."""

    frame_index: int
    log: str
    drive: int
    front: str
    shown: str  # in the front view, in words
    top: str
    close_ups: CloseUps | None
    camera: str = ""  # which one, where the rig has several


def close_ups_of(scene: Scene, before: Extrinsics, after: Extrinsics) -> CloseUps:
    """Windows with most lidar edges at silhouettes, enlarged, at both states."""
    windows = choose_windows(scene.observation, after.T_camera_lidar, _CLOSE_UPS)
    width = windows[0].size_px[0] if windows else 1
    zoom = max(2, round(_CLOSE_UP_WIDTH_PX / width))
    close_ups = []
    for window in windows:
        pair = [jpeg_uri(close_up(scene, s, window, zoom)) for s in (before, after)]
        close_ups.append((pair[0], pair[1]))
    angle = np.degrees(width / camera_of(scene.frame).focal_px[0])
    return CloseUps(close_ups, zoom, f"{angle:.1f}")


def scene_pictures(
    scene: Scene, before: Extrinsics, after: Extrinsics, labels: tuple[str, str], camera_name: str = ""
) -> ScenePictures:
    """Draw and encode all pictures of a chosen frame."""
    camera, lidar, radar = (sensor in scene.observation.sensors for sensor in SENSORS)
    kinds = ["lidar by range"] * lidar + ["moving radar clusters as white +"] * radar
    return ScenePictures(
        scene.frame.frame_index,
        scene.frame.log,
        scene.frame.drive,
        jpeg_uri(front_view(scene, before, after, labels)) if camera else "",
        ", ".join([*kinds, "detected road users as boxes"]).capitalize(),
        top_view(scene, before, after, labels) if lidar and radar else "",
        close_ups_of(scene, before, after) if camera and lidar else None,
        camera_name,
    )

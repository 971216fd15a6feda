"""Pictures of one frame, split into prior and calibrated: front view, top view and close-ups.

Source: paper, figures 1, 3 and 4: lidar in the image coloured by range, moving radar clusters as white '+';
from above lidar coloured by height and radar in black. The close-ups are ours: a few tenths of a degree are
a few pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.rig.cameras import Camera, camera_of
from pipeline.rig.se3 import transform_points
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = [
    "Extrinsics",
    "Scene",
    "Window",
    "close_up",
    "decode_image",
    "front_view",
    "lidar_view",
    "lidar_window",
    "whole_view",
]

Image = UInt8[np.ndarray, "H W 3"]
_NEAR_M, _FAR_M = 4.0, 80.0  # ends of the colour scale; logarithmic between
_MOVING = 1
_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)
_BOX = (80, 220, 255)
_MARGIN = 0.08  # about what the lidar sees, a share of its size
_CANVAS_PX = 1400  # as wide as a page on a laptop
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """Poses of the sensors in one state (prior or calibrated), as far as known."""

    T_camera_lidar: np.ndarray
    T_camera_radar: np.ndarray
    T_lidar_radar: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """One frame with its features."""

    frame: Frame
    observation: Observation


@dataclass(frozen=True)
class Window:
    """Centre and size of a close-up [px of the full image]."""

    centre_px: tuple[float, float]
    size_px: tuple[int, int]

    def corner_px(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Upper left corner of the window, pushed inside an image of that size."""
        x0 = int(np.clip(self.centre_px[0] - self.size_px[0] / 2, 0, max(width_px - self.size_px[0], 0)))
        y0 = int(np.clip(self.centre_px[1] - self.size_px[1] / 2, 0, max(height_px - self.size_px[1], 0)))
        return x0, y0


def decode_image(frame: Frame) -> Image:
    """The logged image (BGR), at the size that the intrinsics refer to; grey where its bytes are no picture."""
    size = (frame.image_width_px, frame.image_height_px)
    image = cv2.imdecode(np.frombuffer(frame.image, np.uint8), cv2.IMREAD_COLOR) if frame.image else None
    if image is None:
        return np.full((size[1], size[0], 3), 96, np.uint8)
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def front_view(scene: Scene, before: Extrinsics, after: Extrinsics, labels: tuple[str, str]) -> Image:
    """Lidar and moving radar in the middle half of the image, left at `before`, right at `after`; `_CANVAS_PX` wide."""
    halves = [_drawn(scene, state) for state in (before, after)]
    middle = halves[0].shape[1] // 2
    seen = slice(middle // 2, middle // 2 + middle)
    image = np.concatenate([half[:, seen] for half in halves], axis=1)
    cv2.line(image, (middle, 0), (middle, image.shape[0]), _WHITE, 3)
    _tag(image, labels[0], (14, 34))
    _tag(image, labels[1], (middle + 14, 34))
    if "lidar" in scene.observation.sensors:
        _colour_bar(image)
    return image


def whole_view(scene: Scene, state: Extrinsics, label: str) -> Image:
    """The whole image at one state, as the front view draws its middle."""
    image = _drawn(scene, state)
    _tag(image, label, (14, 34))
    _colour_bar(image)
    return image


def lidar_view(scene: Scene, state: Extrinsics, window: Window, label: str) -> Image:
    """The window of the whole view that `lidar_window` names, with label and colour bar."""
    image = _drawn(scene, state)
    scale = image.shape[1] / scene.frame.image_width_px
    width, height = (round(v * scale) for v in window.size_px)
    x0, y0 = window.corner_px(scene.frame.image_width_px, scene.frame.image_height_px)
    left, top = round(x0 * scale), round(y0 * scale)
    part = np.ascontiguousarray(image[top : top + height, left : left + width])
    part = cv2.resize(part, (_CANVAS_PX, round(_CANVAS_PX * height / width)), interpolation=cv2.INTER_CUBIC)
    _tag(part, label, (14, 34))
    _colour_bar(part)
    return part


def lidar_window(scene: Scene, state: Extrinsics) -> Window:
    """Part of the image that the lidar covers without its outermost hundredths, with a margin; else all."""
    camera = camera_of(scene.frame)
    uv, _ = _project(camera, state.T_camera_lidar, scene.frame.lidar_xyz_m)
    if not len(uv):
        uv = np.array([[0.0, 0.0], [camera.width_px, camera.height_px]])
    low, high = np.percentile(uv, (1, 99), axis=0)
    size = np.minimum((1 + 2 * _MARGIN) * (high - low), (camera.width_px, camera.height_px))
    centre = (low + high) / 2
    return Window((float(centre[0]), float(centre[1])), (max(1, round(size[0])), max(1, round(size[1]))))


def close_up(scene: Scene, state: Extrinsics, window: Window, zoom: int) -> Image:
    """An enlarged window of the image: the sweep as small dots, its depth jumps ringed.

    With a good calibration, the dots change colour at silhouettes of the image, and the rings are there too.
    """
    camera = camera_of(scene.frame)
    width, height = window.size_px
    x0, y0 = window.corner_px(camera.width_px, camera.height_px)
    part = decode_image(scene.frame)[y0 : y0 + height, x0 : x0 + width]
    picture = cv2.resize(part, (width * zoom, height * zoom), interpolation=cv2.INTER_CUBIC)
    picture = _dimmed(picture, 0.85)
    sweep = _project(camera, state.T_camera_lidar, scene.frame.lidar_xyz_m)
    edges = _project(camera, state.T_camera_lidar, scene.observation.lidar_edge_xyz_m)
    for (uv, distance), radius, ring in ((sweep, 2, False), (edges, 4, True)):
        at = (uv - (x0, y0) + 0.5) * zoom - 0.5
        inside = (at > -radius).all(axis=1) & (at < (width * zoom + radius, height * zoom + radius)).all(
            axis=1
        )
        _dots(picture, at[inside], distance[inside], radius, outline=ring)
    return picture


def _drawn(scene: Scene, state: Extrinsics) -> np.ndarray:
    """The image, dimmed, `_CANVAS_PX` wide, with lidar and radar data."""
    scale = _CANVAS_PX / scene.frame.image_width_px
    camera = camera_of(scene.frame).scaled(scale)
    size, by = (camera.width_px, camera.height_px), cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    image = _dimmed(cv2.resize(decode_image(scene.frame), size, interpolation=by))
    uv, distance = _project(camera, state.T_camera_lidar, scene.frame.lidar_xyz_m)
    # Sparse lidars get larger dots, so that a sweep is seen whatever the number of its rings.
    radius = int(np.clip(np.sqrt(0.012 * image.shape[0] * image.shape[1] / max(len(uv), 1)), 1, 3))
    _dots(image, uv, distance, radius=radius)
    for box in scene.observation.road_user_boxes_px.astype(np.float64) * scale:
        x0, y0, x1, y1 = (round(float(v)) for v in box)
        cv2.rectangle(image, (x0, y0), (x1, y1), _BOX, 1, cv2.LINE_AA)
    uv, _ = _project(camera, state.T_camera_radar, _moving_centres(scene.observation))
    for u, v in uv:
        at = (round(float(u)), round(float(v)))
        cv2.drawMarker(image, at, _BLACK, cv2.MARKER_CROSS, 20, 6)
        cv2.drawMarker(image, at, _WHITE, cv2.MARKER_CROSS, 16, 2)
    return image


def _moving_centres(observation: Observation) -> Float[np.ndarray, "N 3"]:
    """Centres of tracks, or of moving clusters if the drive is too short for tracks."""
    if len(observation.radar_track_xyz_m):
        return observation.radar_track_xyz_m.astype(np.float64)
    cluster = np.where(observation.radar_motion == _MOVING, observation.radar_cluster, -1)
    ids = np.unique(cluster[cluster >= 0])
    centres = [observation.radar_xyz_m[cluster == i].mean(axis=0) for i in ids]
    return np.array(centres, dtype=np.float64).reshape(-1, 3)


def _project(
    camera: Camera, T_camera_sensor: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and distances of the points inside the image."""
    seen = transform_points(T_camera_sensor, points.astype(np.float64))
    uv, valid = camera.project(seen)
    valid &= camera.contains(uv)
    return uv[valid], np.linalg.norm(seen[valid], axis=1)


def _dots(
    image: np.ndarray, uv: np.ndarray, distance_m: np.ndarray, radius: int, *, outline: bool = False
) -> None:
    colour = _range_colours(distance_m)
    for i in np.argsort(-distance_m):  # near ones on top
        at = (round(float(uv[i, 0])), round(float(uv[i, 1])))
        if outline:
            cv2.circle(image, at, radius + 1, _BLACK, -1, cv2.LINE_AA)
        cv2.circle(image, at, radius, colour[i], -1, cv2.LINE_AA)


def _range_colours(distance_m: np.ndarray) -> list[list[int]]:
    share = np.log(np.clip(distance_m, _NEAR_M, _FAR_M) / _NEAR_M) / np.log(_FAR_M / _NEAR_M)
    level = np.round(255 * (1 - share)).astype(np.uint8)  # near = red
    return cv2.applyColorMap(level.reshape(-1, 1), cv2.COLORMAP_TURBO)[:, 0].tolist() if len(level) else []


def _dimmed(image: np.ndarray, brightness: float = 0.7) -> np.ndarray:
    """The image with less colour and an even brightness, so that coloured dots are visible both at dusk and on snow."""
    grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    gain = float(np.clip(120 * brightness / max(float(grey.mean()), 1.0), 0.6, 1.8))
    return cv2.addWeighted(image, 0.35 * gain, grey, 0.65 * gain, 0)


def _tag(image: np.ndarray, text: str, at: tuple[int, int]) -> None:
    (width, height), base = cv2.getTextSize(text, _FONT, 0.8, 2)
    cv2.rectangle(image, (at[0] - 6, at[1] - height - 8), (at[0] + width + 6, at[1] + base + 2), _BLACK, -1)
    cv2.putText(image, text, at, _FONT, 0.8, _WHITE, 2, cv2.LINE_AA)


def _colour_bar(image: np.ndarray) -> None:
    width, height = 220, 12
    x0, y0 = image.shape[1] - width - 70, image.shape[0] - height - 14
    image[y0 - 4 : y0 + height + 4, x0 - 60 : x0 + width + 66] //= 3
    image[y0 : y0 + height, x0 : x0 + width] = _range_colours(np.geomspace(_NEAR_M, _FAR_M, width))
    for text, x in ((f"{_NEAR_M:.0f} m", x0 - 48), (f"{_FAR_M:.0f} m", x0 + width + 8)):
        cv2.putText(image, text, (x, y0 + height), _FONT, 0.5, _WHITE, 1, cv2.LINE_AA)

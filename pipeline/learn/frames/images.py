"""Images, labels and boxes of a camera without distortion, for formats that have none."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core.errors import ConfigError
from pipeline.rig.cameras import Camera, camera_of
from schemas.captures import CameraColumns, Image
from schemas.features import ImageFeatureColumns

__all__ = ["Boxes", "Undistortion", "undistortion_of"]

_WIDEST_DEG = 170.0  # a plane shows nothing at 180 deg, and next to nothing beyond this
_VOID = 255
Boxes = list[tuple[list[float], str, float]]  # x0 y0 x1 y1 [px], class, score


@dataclass(frozen=True, eq=False)
class Undistortion:
    """From a camera's images to those of a pinhole camera with the same K and size; edges of a wide view are lost."""

    camera: Camera
    # Where in the image each pixel comes from; None: it has no distortion.
    maps: tuple[np.ndarray, np.ndarray] | None

    def pixels(self, data: bytes) -> UInt8[np.ndarray, "H W 3"]:
        """Decoded image, black where the camera saw nothing; raises ConfigError if it cannot be decoded."""
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            raise ConfigError("lake", "images", "an image cannot be decoded")
        return image if self.maps is None else cv2.remap(image, *self.maps, cv2.INTER_LINEAR)

    def encoded(self, image: Image, suffix: str) -> bytes:
        """An image as a file; as logged, byte for byte, if it has that format and no distortion."""
        if self.maps is None and {"jpeg": ".jpg", "png": ".png"}[image.image_format] == suffix:
            return image.image
        options = [cv2.IMWRITE_JPEG_QUALITY, 95] if suffix == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 1]
        return cv2.imencode(suffix, self.pixels(image.image), options)[1].tobytes()

    def labels(self, found: ImageFeatureColumns) -> bytes:
        """A label image at the image's size, nearest neighbours, void where the camera saw nothing."""
        small = cv2.imdecode(np.frombuffer(found.labels_png, np.uint8), cv2.IMREAD_UNCHANGED)
        size = (self.camera.width_px, self.camera.height_px)
        full = cv2.resize(small, size, interpolation=cv2.INTER_NEAREST)
        if self.maps is not None:
            full = cv2.remap(
                full, *self.maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=_VOID
            )
        return cv2.imencode(".png", full)[1].tobytes()

    def boxes(self, found: ImageFeatureColumns) -> Boxes:
        """Boxes around the undistorted corners and edge centres of the logged ones."""
        told = zip(found.road_user_boxes_px, found.road_user_classes, found.road_user_scores, strict=True)
        moved = [(self._box(box), name, float(score)) for box, name, score in told]
        return [(box, name, score) for box, name, score in moved if box is not None]

    def _box(self, box: Float[np.ndarray, " 4"]) -> list[float] | None:
        size = np.array([self.camera.width_px, self.camera.height_px]) - 1
        corners = np.array([(u, v) for u in (box[0], (box[0] + box[2]) / 2, box[2])
                            for v in (box[1], (box[1] + box[3]) / 2, box[3])], np.float64)  # fmt: skip
        if self.maps is not None:
            rays = self.camera.unproject(corners)
            rays = rays[rays[:, 2] > 0]  # False for NaN, too
            corners = (rays / rays[:, 2:]) @ self.camera.K.T
        if not len(corners):
            return None
        low, high = (
            np.clip(end, 0, size) for end in (corners[:, :2].min(axis=0), corners[:, :2].max(axis=0))
        )
        return [*map(float, low), *map(float, high)] if np.all(high > low) else None


def undistortion_of(image: CameraColumns, sensor: str) -> Undistortion:
    """Maps to a pinhole camera, cached; raises ConfigError if the camera sees more than a plane shows."""
    c = camera_of(image)
    return _made(sensor, c.model, c.K.tobytes(), c.D.tobytes(), c.width_px, c.height_px)


@lru_cache(maxsize=16)
def _made(sensor: str, model: str, K: bytes, D: bytes, width_px: int, height_px: int) -> Undistortion:
    camera = Camera(model, np.frombuffer(K).reshape(3, 3), np.frombuffer(D), width_px, height_px)
    seen = _field_deg(camera)
    if seen > _WIDEST_DEG:
        problem = (
            f"sees {seen:.0f} deg, and an undistorted image can show {_WIDEST_DEG:.0f} at most: take parquet, "
            "whose images are as logged, or leave the camera out with --sensor"
        )
        raise ConfigError("command line", sensor, problem)
    if model != "equidistant" and not np.any(camera.D):
        return Undistortion(camera, None)
    u, v = np.meshgrid(np.arange(width_px), np.arange(height_px))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.K).T
    uv, valid = camera.project(rays)
    uv = np.where(valid[..., None], uv, -1e4).astype(np.float32)
    return Undistortion(camera, (np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])))


def _field_deg(camera: Camera) -> float:
    """Angle between the rays of the middle of the left and of the right side."""
    v = float(camera.K[1, 2])
    ends = camera.unproject(np.array([[0.0, v], [camera.width_px - 1.0, v]]))
    angles = np.arctan2(np.abs(ends[:, 0]), ends[:, 2])
    known = np.where(np.isfinite(angles), angles, camera.max_angle_rad)
    return float(np.degrees(known.sum()))

"""A small synthetic frame: a road between two walls with a driving car, seen by all three sensors."""

from collections.abc import Callable
from dataclasses import fields

import cv2
import numpy as np
import pytest

from schemas.calibrations import SENSORS
from schemas.frames import Frame

WIDTH, HEIGHT = 400, 240


def _image() -> np.ndarray:
    """Sky, buildings, road with a lane line, and two cars."""
    image = np.full((HEIGHT, WIDTH, 3), (200, 180, 160), np.uint8)
    image[80:120] = (90, 100, 110)
    image[120:] = (60, 60, 60)
    image[120:, 195:203] = (220, 220, 220)
    image[100:150, 60:140] = (40, 20, 120)
    return image


def _labels() -> np.ndarray:
    labels = np.full((HEIGHT // 2, WIDTH // 2), 10, np.uint8)
    labels[40:60] = 2
    labels[60:] = 0
    labels[50:75, 30:70] = 13
    return labels


def _lidar(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    azimuth, beam = np.meshgrid(np.radians(np.arange(-90, 90, 0.4)), np.arange(32))
    elevation = np.radians(-20 + 0.9 * beam)
    rays = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1
    )
    with np.errstate(divide="ignore"):
        ground = np.where(rays[..., 2] < 0, -1.7 / rays[..., 2], np.inf)
        wall = 8.0 / np.abs(rays[..., 1])
    distance = np.minimum(ground, wall)
    seen = distance < 80
    points = rays[seen] * (distance[seen] + rng.normal(0, 0.02, seen.sum()))[:, None]
    car = rng.uniform([14.0, -1.0, -1.4], [14.2, 1.0, -0.2], (300, 3))
    return np.concatenate([points, car]).astype(np.float32), np.append(beam[seen], np.full(300, 12)).astype(
        np.uint16
    )


def _radar(
    rng: np.random.Generator, speed: float, car_m: float, car_speed: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns of the walls, and of a car ahead; range rates over a radar that drives straight."""
    x = rng.uniform(4, 50, 400)
    walls = np.stack([x, np.where(np.arange(400) % 2, 8.0, -8.0), rng.normal(0, 0.3, 400)], 1)
    car = rng.normal([car_m, 1.0, 0.0], [0.4, 0.3, 0.2], (12, 3))
    points = np.concatenate([walls, car])
    u = points / np.linalg.norm(points, axis=1, keepdims=True)
    rate = -speed * u[:, 0] + np.append(np.zeros(400), np.full(12, car_speed)) * u[:, 0]
    return points.astype(np.float32), (rate + rng.normal(0, 0.05, 412)).astype(np.float32)


def make_frame(index: int = 0, *, speed: float = 8.0, car_m: float = 20.0, car_speed: float = 5.0) -> Frame:
    """Frame number `index` of a drive at 10 frames/s."""
    rng = np.random.default_rng(index)
    lidar, ring = _lidar(rng)
    radar, rate = _radar(rng, speed, car_m + (car_speed - speed) * 0.1 * index, car_speed)
    stamp_ns = 1_700_000_000_000_000_000 + index * 100_000_000
    boxes = [[60, 100, 140, 150], [200, 90, 220, 140], [10, 10, 20, 30], [300, 100, 330, 120]]
    values = {f.name: None for f in fields(Frame)} | {
        "sensors": list(SENSORS), "priors": {},
        "frame_index": index, "log": "made.mcap", "drive": 0, "stamp_ns": stamp_ns,
        "camera_stamp_ns": stamp_ns, "lidar_stamp_ns": stamp_ns, "radar_stamp_ns": stamp_ns,
        "image": cv2.imencode(".jpg", _image())[1].tobytes(), "image_format": "jpeg",
        "image_width_px": WIDTH, "image_height_px": HEIGHT, "camera_model": "plumb_bob",
        "camera_K": np.array([[300.0, 0, 199.5], [0, 300.0, 119.5], [0, 0, 1]]), "camera_D": np.zeros(0),
        "labels_png": cv2.imencode(".png", _labels())[1].tobytes(),
        "detection_boxes_px": np.array(boxes, np.float32),
        "detection_classes": ["car", "pedestrian", "traffic light", "car"],
        "detection_scores": np.array([0.9, 0.6, 0.9, 0.1], np.float32),
        "lidar_x_m": lidar[:, 0].copy(), "lidar_y_m": lidar[:, 1].copy(), "lidar_z_m": lidar[:, 2].copy(),
        "lidar_intensity": rng.uniform(5, 20, len(lidar)).astype(np.float32), "lidar_ring": ring,
        "lidar_deskewed": True,
        "radar_x_m": radar[:, 0].copy(), "radar_y_m": radar[:, 1].copy(), "radar_z_m": radar[:, 2].copy(),
        "radar_range_rate_mps": rate, "radar_has_elevation": True,
    }  # fmt: skip
    return Frame(**values)


@pytest.fixture(scope="session")
def made_frame() -> Callable[..., Frame]:
    """Makes frames of the synthetic drive."""
    return make_frame

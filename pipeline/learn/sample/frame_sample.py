"""One frame with its features, as a row of table `training`; maps of a label image: classes and boundaries.

Maps are computed on a fine grid of 0.1 deg and sampled at the centres of the cells, so large cells do not blur
boundaries. On this grid a horizontal step is shorter than a vertical one by the cosine of the elevation: 3 % at 14 deg,
to which no loss is sensitive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32, UInt8

from pipeline.core.config import PrepareConfig
from pipeline.learn.sample.clouds import View, lidar_columns, own_velocity, padded_rows, radar_columns
from pipeline.learn.sample.grid import CLASS_CONFIDENCE, Grid, grid_rays, resample_camera
from pipeline.objective.camera_lidar.image_maps import NO_BOUNDARY, boundary_offsets
from pipeline.objective.paper.classes import labels_of
from pipeline.rig.cameras import Camera, camera_of
from pipeline.rig.estimates import Prior
from pipeline.rig.graph import pose_columns
from pipeline.rig.se3 import camera_direction_angles
from schemas.frames import Frame
from schemas.observations import Observation
from schemas.training import CLASS_OF_LABEL, GRID_CLASSES, NO_EDGE, UNKNOWN_CLASS, TrainingRow

__all__ = [
    "About", "Reference", "SampleReason", "SampleRejectedError", "camera_features", "class_likelihood",
    "fingerprint", "make_row", "sensor_row", "stored_grid",
]  # fmt: skip

_DETECTIONS = 24
_MIN_POINTS = 300  # fewer in view show a network no shape
_MIN_SEEN = 0.2  # of the grid: a camera narrower than that has another grid


class SampleReason(StrEnum):
    """Why a frame is no sample."""

    NOT_PERCEIVED = "not_perceived"
    SENSOR_MISSING = "sensor_missing"
    HARDLY_MOVED = "hardly_moved"
    SPLIT_CONFLICT = "split_conflict"
    NEXT_TO_OTHER_SPLIT = "next_to_other_split"
    NOT_NEEDED = "not_needed"
    UNDECODABLE_IMAGE = "undecodable_image"
    NARROW_VIEW = "narrow_view"
    FEW_LIDAR_POINTS = "few_lidar_points_in_view"
    NO_PRIOR = "no_prior"
    PRIOR_CHANGED = "prior_changed"


class SampleRejectedError(Exception):
    """A frame that is no sample."""

    def __init__(self, reason: SampleReason) -> None:
        self.reason = reason
        super().__init__(reason.value)


@dataclass(frozen=True)
class About:
    """Facts of a row that neither frame nor observation contains."""

    vehicle: str
    day: str
    rig: str
    split: str
    place: str
    environment: str


@dataclass(frozen=True, eq=False)
class Reference:
    """Poses and clocks at which a day's losses look: of its record of `joint`, else those before the day.

    Args:
        poses: transforms of the three sensors.
        name: "joint" or "prior".
        dt_camera_lidar_s: stamp_camera = stamp_lidar + dt.
        dt_lidar_radar_s: stamp_lidar = stamp_radar + dt.
    """

    poses: Prior
    name: str = "prior"
    dt_camera_lidar_s: float = 0.0
    dt_lidar_radar_s: float = 0.0


def make_row(
    frame: Frame, observation: Observation, reference: Reference, about: About, config: PrepareConfig
) -> TrainingRow:
    """The row of one frame, deterministic; raises SampleRejectedError if the frame shows too little."""
    sensors = sensor_row(frame, observation, reference.poses, about, config)
    grid = stored_grid(config.grid.shape, config.grid.step_deg)
    camera = camera_of(observation)
    grid_class, edge_offset = camera_features(labels_of(observation), camera, grid)
    return replace(
        sensors, grid_class=grid_class.ravel(), edge_offset=edge_offset.reshape(4, -1), reference=reference.name,
        camera_lag_s=sensors.camera_lag_s - reference.dt_camera_lidar_s,
        radar_lag_s=sensors.radar_lag_s + reference.dt_lidar_radar_s,
        **_detection_columns(observation, camera),
    )  # fmt: skip


def sensor_row(
    frame: Frame, observation: Observation, prior: Prior, about: About, config: PrepareConfig
) -> TrainingRow:
    """A row for inference: columns that only losses use (semantics) are 0.

    `prior` is the row's reference, and decides which lidar points are in view.

    Raises:
        SampleRejectedError: the frame shows too little.
    """
    # One generator per frame: the row does not depend on which frames came before.
    rng = np.random.default_rng([frame.stamp_ns & 0x7FFFFFFFFFFFFFFF, frame.frame_index, config.seed])
    height, width = config.grid.shape
    grid = stored_grid((height, width), config.grid.step_deg)
    small, seen = resample_camera(_decode_small(frame, config.grid.step_deg), camera_of(observation), grid)
    if seen.mean() < _MIN_SEEN:
        raise SampleRejectedError(SampleReason.NARROW_VIEW)
    lidar = lidar_columns(frame, observation, View(prior, grid), config, rng)
    if lidar["lidar_count"] < _MIN_POINTS:
        raise SampleRejectedError(SampleReason.FEW_LIDAR_POINTS)
    cells = height * width
    return TrainingRow(
        frame_index=frame.frame_index,
        **about.__dict__,
        drive=frame.drive,
        stamp_ns=frame.stamp_ns,
        fingerprint=fingerprint(small),
        grid_step_deg=config.grid.step_deg,
        grid_height=height,
        grid_width=width,
        image=small[..., ::-1].transpose(2, 0, 1).reshape(3, -1),  # OpenCV decodes blue first
        grid_seen=seen.ravel(),
        grid_class=np.zeros(cells, np.uint8),
        edge_offset=np.zeros((4, cells), np.int8),
        detection_box_rad=np.zeros((_DETECTIONS, 4), np.float32),
        detection_count=0,
        **lidar,
        **radar_columns(observation, rng),
        **_reference_columns(observation, prior),
    )


def _decode_small(frame: Frame, cell_deg: float) -> UInt8[np.ndarray, "Y X 3"]:
    """The image as BGR, JPEG reduced while decoding to at least two pixels per cell.

    Raises:
        SampleRejectedError: undecodable, or another size than that of the intrinsics.
    """
    focal_px = float(max(frame.camera_K[0, 0], frame.camera_K[1, 1]))
    per_cell = np.radians(cell_deg) * focal_px
    reduction = next((r for r in (4, 2) if per_cell >= 2 * r), 1) if frame.image_format == "jpeg" else 1
    flag = {1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4}[reduction]
    try:
        image = cv2.imdecode(np.frombuffer(frame.image, np.uint8), flag | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    sides = (frame.image_height_px, frame.image_width_px)
    if image is None or image.shape[:2] != tuple(-(-side // reduction) for side in sides):
        raise SampleRejectedError(SampleReason.UNDECODABLE_IMAGE)
    return image


def fingerprint(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, " 32"]:
    """256 bits, whether each of 16 x 16 patches is darker than its right neighbour; similar for the same view."""
    grey = cv2.resize(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (17, 16), interpolation=cv2.INTER_AREA)
    return np.packbits(grey[:, 1:] > grey[:, :-1])


def _detection_columns(observation: Observation, camera: Camera) -> dict[str, Any]:
    """Boxes as angles at the middles of their sides (left, top, right, bottom), without those beyond the camera."""
    x0, y0, x1, y1 = observation.road_user_boxes_px.astype(np.float64).reshape(-1, 4).T
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    sides = np.stack([np.stack(p, -1) for p in ((x0, y), (x, y0), (x1, y), (x, y1))], 1)
    angles = camera_direction_angles(camera.unproject(sides))[:, range(4), [0, 1, 0, 1]]
    rows = np.flatnonzero(np.isfinite(angles).all(axis=1))
    rows = rows[np.argsort(-observation.road_user_scores[rows], kind="stable")][:_DETECTIONS]
    return {
        "detection_box_rad": padded_rows(angles[rows].astype(np.float32), _DETECTIONS),
        "detection_count": len(rows),
    }


def _reference_columns(observation: Observation, prior: Prior) -> dict[str, Any]:
    """Own motion, the clocks as stamped, and the poses."""
    columns: dict[str, Any] = {
        "reference": "prior",
        "ego_velocity_mps": own_velocity(observation, prior.T_lidar_radar).astype(np.float32),
        "ego_yaw_rate_radps": observation.ego_yaw_rate_radps or 0.0,
        "camera_lag_s": (observation.camera_stamp_ns - observation.stamp_ns) * 1e-9,
        "radar_lag_s": (observation.radar_stamp_ns - observation.stamp_ns) * 1e-9,
    }
    for pair in ("camera_lidar", "lidar_radar"):
        columns |= pose_columns(prior.of(pair), f"reference_{pair}_")
    return columns


_FINE_DEG = 0.1
_VOID_LABEL = 255
_EDGE_STEPS = 2  # boundaries are stored in halves of a fine cell: centres of cells lie between fine cells


def stored_grid(shape: tuple[int, int], step_deg: float) -> Grid:
    """The grid of (height, width) cells about the optical axis."""
    height, width = shape
    return Grid(step_deg, width / 2 * step_deg, height / 2 * step_deg, -height / 2 * step_deg)


def camera_features(
    labels: UInt8[np.ndarray, "Y X"], camera: Camera, grid: Grid
) -> tuple[UInt8[np.ndarray, "H W"], Int8[np.ndarray, "4 H W"]]:
    """Columns grid_class and edge_offset of table `training`, as maps.

    A cell has the class of at least half of it. `labels` are Cityscapes train ids; `camera` belongs to the full
    image.
    """
    fine = _sample_finely(labels, camera, grid)
    share = _shares(fine, grid)
    grid_class = np.where(share.max(axis=0) >= 0.5, share.argmax(axis=0), UNKNOWN_CLASS).astype(np.uint8)
    return grid_class, _edge_offsets(fine, round(grid.cell_deg / _FINE_DEG))


def class_likelihood(
    labels: UInt8[np.ndarray, "Y X"], camera: Camera, grid: Grid
) -> Float32[np.ndarray, "C H W"]:
    """Class input of a network: likelihood of each class, and 1 if at least half of the cell has a class, else 0.

    A cell that a boundary crosses has shares of both classes; arguments as of `camera_features`.
    """
    share = _shares(_sample_finely(labels, camera, grid), grid)
    total = share.sum(axis=0)
    known = (total >= 0.5).astype(np.float32)
    doubt = np.float32((1 - CLASS_CONFIDENCE) / len(share))
    likelihood = np.float32(CLASS_CONFIDENCE) * share / np.maximum(total, np.float32(0.5)) + doubt
    return np.concatenate([likelihood * known, known[None]]).astype(np.float32)


def _shares(fine: np.ndarray, grid: Grid) -> Float32[np.ndarray, "K H W"]:
    """Share of each class in each cell of finely sampled labels."""
    classes, size = CLASS_OF_LABEL[fine], (grid.width, grid.height)
    planes = ((classes == k).astype(np.float32) for k in range(len(GRID_CLASSES)))
    return np.stack([cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in planes])


def _sample_finely(labels: np.ndarray, camera: Camera, grid: Grid) -> UInt8[np.ndarray, "Y X"]:
    key = (camera.model, camera.K.tobytes(), camera.D.tobytes(), camera.width_px, camera.height_px)
    index, seen = _pixels(key, labels.shape, grid)
    return np.where(seen, labels.ravel()[index], _VOID_LABEL).astype(np.uint8)


@lru_cache(maxsize=4)  # one camera per vehicle-day; the projection costs more than all the rest
def _pixels(
    camera_key: tuple[str, bytes, bytes, int, int], size: tuple[int, int], grid: Grid
) -> tuple[Int32[np.ndarray, "Y X"], Bool[np.ndarray, "Y X"]]:
    """Flat index of the label pixel under each fine cell, and whether it exists."""
    model, K, D, width, height = camera_key
    camera = Camera(model, np.frombuffer(K).reshape(3, 3), np.frombuffer(D), width, height)
    small = camera.scaled(size[1] / width)
    uv, valid = small.project(grid_rays(grid.finer(round(grid.cell_deg / _FINE_DEG))))
    u, v = np.rint(uv[..., 0]), np.rint(uv[..., 1])  # pixel centres are integers
    seen = valid & (u >= 0) & (v >= 0) & (u < size[1]) & (v < size[0])
    index = np.where(seen, v * size[1] + u, 0).astype(np.int32)
    return index, seen


def _edge_offsets(labels: np.ndarray, per_cell: int) -> np.ndarray:
    """Signed distance from each cell's centre to the nearest boundary by direction, in halves of a fine cell."""
    middle = per_cell // 2
    offsets = boundary_offsets(labels)[:, middle::per_cell, middle::per_cell].astype(np.int16)
    # A boundary lies half a fine cell behind pixel + offset, and the cell's centre (per_cell - 1) / 2 - middle
    # of one beside the pixel that was looked at.
    halves = _EDGE_STEPS * offsets + 1 - (per_cell - 1 - 2 * middle)
    known = (offsets != NO_BOUNDARY) & (np.abs(halves) <= 127)
    return np.where(known, halves, NO_EDGE).astype(np.int8)

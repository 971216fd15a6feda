"""One frame with its features, as a row of table `training`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.core.config import PrepareConfig
from pipeline.learn.sample.camera_maps import camera_features, stored_grid
from pipeline.learn.sample.clouds import View, lidar_columns, own_velocity, padded_rows, radar_columns
from pipeline.learn.sample.grid import resample_camera
from pipeline.objective.paper.classes import labels_of
from pipeline.rig.cameras import Camera, camera_of
from pipeline.rig.edges import pose_columns
from pipeline.rig.estimates import Prior
from pipeline.rig.spherical import camera_direction_angles
from schemas.frames import Frame
from schemas.observations import Observation
from schemas.training import TrainingRow

__all__ = [
    "About",
    "Reference",
    "SampleReason",
    "SampleRejectedError",
    "fingerprint",
    "make_row",
    "sensor_row",
]

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
        sensors,
        grid_class=grid_class.ravel(),
        edge_offset=edge_offset.reshape(4, -1),
        reference=reference.name,
        camera_lag_s=sensors.camera_lag_s - reference.dt_camera_lidar_s,
        radar_lag_s=sensors.radar_lag_s + reference.dt_lidar_radar_s,
        **_detection_columns(observation, camera),
    )


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

"""Foxglove's messages of sensors, poses and drawings. Source: foxglove-sdk 0.30, schemas of the same names."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from foxglove import messages as fg
from jaxtyping import Float

from pipeline.rig.cameras import Camera, camera_of
from pipeline.rig.se3 import to_quaternion, transform_points
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = [
    "CALIBRATED",
    "PRIOR",
    "boxes_message",
    "cloud_columns",
    "cloud_message",
    "clusters_message",
    "edges_message",
    "intrinsics_message",
    "time_message",
    "transform_message",
]

_MODELS = {"equidistant": "kannala_brandt"}  # ROS's name -> Foxglove's name
_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
_FLOAT32 = fg.PackedElementFieldNumericType.Float32
CALIBRATED, PRIOR, _BOX = (0.2, 0.9, 0.4), (1.0, 0.45, 0.1), (0.3, 0.85, 1.0)  # red, green, blue
# Foxglove's pixel coordinates start at the corner of the first pixel, Boresight's at its centre
_PIXEL_CENTRE = 0.5


def transform_message(
    parent: str, child: str, T: Float[np.ndarray, "4 4"], stamp_ns: int
) -> fg.FrameTransform:
    """Pose of child in parent as a message."""
    w, x, y, z = (float(v) for v in to_quaternion(T))
    return fg.FrameTransform(
        timestamp=time_message(stamp_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=fg.Vector3(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3])),
        rotation=fg.Quaternion(x=x, y=y, z=z, w=w),
    )


def time_message(stamp_ns: int) -> fg.Timestamp:
    """Stamp as a message."""
    return fg.Timestamp(sec=stamp_ns // 10**9, nsec=stamp_ns % 10**9)


# -- sensors ----------------------------------------------------------------


def intrinsics_message(camera: Camera, frame_id: str, at: fg.Timestamp) -> fg.CameraCalibration:
    """Intrinsics of a camera as a message, with Foxglove's names of the lens models."""
    D = np.zeros(_COEFFICIENTS[camera.model])
    D[: len(camera.D)] = camera.D
    P = np.hstack([camera.K, np.zeros((3, 1))])
    return fg.CameraCalibration(
        timestamp=at,
        frame_id=frame_id,
        width=camera.width_px,
        height=camera.height_px,
        distortion_model=_MODELS.get(camera.model, camera.model),
        D=D.tolist(),
        K=np.asarray(camera.K, np.float64).reshape(-1).tolist(),
        R=np.eye(3).reshape(-1).tolist(),
        P=P.reshape(-1).tolist(),
    )


def cloud_columns(frame: Frame, kind: str) -> tuple[dict[str, np.ndarray], int]:
    """Points of the frame's lidar or radar by field, and their stamp [ns]; range rate positive = receding."""
    columns = {axis: getattr(frame, f"{kind}_{axis}_m") for axis in "xyz"}
    if kind == "lidar":
        columns["intensity"], stamp_ns = frame.lidar_intensity, frame.stamp_ns
    else:
        columns |= {"range_rate_mps": frame.radar_range_rate_mps, "power_db": frame.radar_power_db}
        stamp_ns = frame.radar_stamp_ns
    return {name: column for name, column in columns.items() if column is not None}, stamp_ns


def cloud_message(columns: Mapping[str, np.ndarray], frame_id: str, stamp_ns: int) -> fg.PointCloud:
    """Points as a message; the columns have equal length."""
    points = np.stack([np.asarray(c, "<f4") for c in columns.values()], axis=1)
    fields = [fg.PackedElementField(name=n, offset=4 * i, type=_FLOAT32) for i, n in enumerate(columns)]
    return fg.PointCloud(
        timestamp=time_message(stamp_ns),
        frame_id=frame_id,
        pose=_unturned(0.0, 0.0, 0.0),
        point_stride=4 * len(columns),
        fields=fields,
        data=points.tobytes(),
    )


# -- drawings ---------------------------------------------------------------


def boxes_message(observation: Observation, at: fg.Timestamp) -> fg.ImageAnnotations:
    """Boxes of road users in the image, with their classes."""
    points, texts = [], []
    boxes = observation.road_user_boxes_px.astype(np.float64) + _PIXEL_CENTRE
    for (x0, y0, x1, y1), name in zip(boxes.tolist(), observation.road_user_classes, strict=True):
        corners = [fg.Point2(x=x, y=y) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
        kind = fg.PointsAnnotationType.LineLoop
        points.append(
            fg.PointsAnnotation(
                timestamp=at, type=kind, points=corners, outline_color=_colour(_BOX), thickness=2.0
            )
        )
        place = fg.Point2(x=x0, y=y0)
        texts.append(
            fg.TextAnnotation(
                timestamp=at, position=place, text=name, font_size=14.0, text_color=_colour(_BOX)
            )
        )
    return fg.ImageAnnotations(timestamp=at, points=points, texts=texts)


def edges_message(
    observation: Observation,
    T_camera_lidar: Float[np.ndarray, "4 4"],
    colour: tuple[float, ...],
    at: fg.Timestamp,
) -> fg.ImageAnnotations:
    """Depth jumps of the lidar in the image; with a good calibration they are on silhouettes."""
    camera = camera_of(observation)
    uv, valid = camera.project(
        transform_points(T_camera_lidar, observation.lidar_edge_xyz_m.astype(np.float64))
    )
    seen = uv[valid & camera.contains(uv)] + _PIXEL_CENTRE
    dots = fg.PointsAnnotation(
        timestamp=at,
        type=fg.PointsAnnotationType.Points,
        points=[fg.Point2(x=u, y=v) for u, v in seen.tolist()],
        outline_color=_colour(colour),
        thickness=3.0,
    )
    return fg.ImageAnnotations(timestamp=at, points=[dots])


def clusters_message(observation: Observation, frame_id: str, stamp_ns: int) -> fg.SceneUpdate:
    """Clusters of the lidar as boxes parallel to its axes."""
    low, high = observation.lidar_cluster_min_m.astype(float), observation.lidar_cluster_max_m.astype(float)
    cubes = [
        fg.CubePrimitive(
            pose=_unturned(*c),
            size=fg.Vector3(x=s[0], y=s[1], z=s[2]),
            color=_colour(_BOX, 0.25),
        )
        for c, s in zip(((low + high) / 2).tolist(), (high - low).tolist(), strict=True)
    ]
    entity = fg.SceneEntity(timestamp=time_message(stamp_ns), frame_id=frame_id, id="clusters", cubes=cubes)
    return fg.SceneUpdate(entities=[entity])


def _unturned(x: float, y: float, z: float) -> fg.Pose:
    turn = fg.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    return fg.Pose(position=fg.Vector3(x=x, y=y, z=z), orientation=turn)


def _colour(rgb: tuple[float, ...], opacity: float = 1.0) -> fg.Color:
    return fg.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=opacity)

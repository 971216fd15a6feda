"""A vehicle-day as a Foxglove MCAP: sensor data at the prior and at the calibration, and the uncertainty.

Frames: the lidar is the root (or base, if its pose is known); camera and radar are its children, as
calibrated. The same points are also written in separate frames at the prior: `lidar_prior`, child of the
camera, and `radar_prior`, child of the lidar. A viewer shows both, and either can be hidden. Source:
foxglove-sdk 0.30, schemas of the same names.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, BinaryIO

import foxglove
import numpy as np
from foxglove import channels
from foxglove import messages as fg
from jaxtyping import Float

from pipeline.export.calibration import ExportedCalibration, poses_of
from pipeline.export.foxglove_table import TABLE_SCHEMA, table_of
from pipeline.export.provenance import provenance_of
from pipeline.export.texts import to_json
from pipeline.rig.cameras import Camera, camera_of
from pipeline.rig.se3 import to_quaternion, transform_points
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = [
    "CALIBRATED",
    "PRIOR",
    "TOPICS",
    "Scene",
    "boxes_message",
    "cloud_columns",
    "cloud_message",
    "clusters_message",
    "edges_message",
    "intrinsics_message",
    "time_message",
    "transform_message",
    "write_foxglove",
]

Scene = tuple[Frame, Observation | None]
TOPICS = {
    "image": "/camera/image",
    "camera": "/camera/calibration",
    "boxes": "/camera/boxes",
    "overlay": "/camera/overlay",
    "overlay_prior": "/camera/overlay_prior",
    "lidar": "/lidar/points",
    "lidar_prior": "/lidar/points_prior",
    "clusters": "/lidar/boxes",
    "radar": "/radar/points",
    "radar_prior": "/radar/points_prior",
    "tf": "/tf",
    "table": "/boresight/calibration",
}
_MODELS = {"equidistant": "kannala_brandt"}  # ROS's name -> Foxglove's name
_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
_FLOAT32 = fg.PackedElementFieldNumericType.Float32
CALIBRATED, PRIOR, _BOX = (0.2, 0.9, 0.4), (1.0, 0.45, 0.1), (0.3, 0.85, 1.0)  # red, green, blue
# Foxglove's pixel coordinates start at the corner of the first pixel, Boresight's at its centre
_PIXEL_CENTRE = 0.5


def write_foxglove(
    stream: BinaryIO,
    calibration: ExportedCalibration,
    priors: Mapping[str, Float[np.ndarray, "4 4"]],
    scenes: Iterable[Scene],
) -> int:
    """Write the scenes, in order of stamp, as an MCAP to a seekable stream; returns their number.

    For a pair without calibration, only the prior is drawn. Features are None for frames that perception left out.
    """
    context = foxglove.Context()
    topics = _Topics(context)
    provenance = provenance_of(calibration)
    count = stamp_ns = 0
    with foxglove.open_mcap(stream, context=context) as writer:
        for frame, observation in scenes:
            stamp_ns = frame.stamp_ns
            if not count:
                topics.table.log(table_of(calibration, priors), log_time=stamp_ns)
            _log_scene(topics, calibration, priors, frame, observation)
            count += 1
        told = {name: str(provenance[name]) for name in ("written_by", "vehicle", "source", "method")}
        writer.write_metadata("boresight", told)
        # Not at time 0: viewers include attachments in the length of the recording.
        media, times = "application/json", {"log_time": stamp_ns, "create_time": stamp_ns}
        writer.attach(**times, name="calibration.json", media_type=media, data=to_json(provenance))
    return count


class _Topics:
    """A channel for each topic."""

    def __init__(self, context: foxglove.Context) -> None:
        def new(kind: Any, name: str) -> Any:
            return kind(TOPICS[name], context=context)

        self.image = new(channels.CompressedImageChannel, "image")
        self.camera = new(channels.CameraCalibrationChannel, "camera")
        self.tf = new(channels.FrameTransformsChannel, "tf")
        self.clusters = new(channels.SceneUpdateChannel, "clusters")
        clouds, drawn = (
            ("lidar", "lidar_prior", "radar", "radar_prior"),
            ("boxes", "overlay", "overlay_prior"),
        )
        self.cloud = {name: new(channels.PointCloudChannel, name) for name in clouds}
        self.drawn = {name: new(channels.ImageAnnotationsChannel, name) for name in drawn}
        self.table = foxglove.Channel(TOPICS["table"], schema=TABLE_SCHEMA, context=context)


def _log_scene(
    topics: _Topics,
    calibration: ExportedCalibration,
    priors: Mapping[str, np.ndarray],
    frame: Frame,
    observation: Observation | None,
) -> None:
    now, names = frame.stamp_ns, calibration.names
    topics.tf.log(fg.FrameTransforms(transforms=_transforms(calibration, priors, now)), log_time=now)
    at, has_image = time_message(frame.camera_stamp_ns), "camera" in frame.sensors
    if has_image:
        picture = fg.CompressedImage(
            timestamp=at, frame_id=names.camera, data=frame.image, format=frame.image_format
        )
        topics.image.log(picture, log_time=now)
        topics.camera.log(intrinsics_message(camera_of(frame), names.camera, at), log_time=now)
    for sensor, pair in (("lidar", "camera_lidar"), ("radar", "lidar_radar")):
        if sensor not in frame.sensors:
            continue
        (columns, stamp_ns), frame_id = cloud_columns(frame, sensor), names.of(sensor)
        topics.cloud[sensor].log(cloud_message(columns, frame_id, stamp_ns), log_time=now)
        if pair in priors:
            topics.cloud[f"{sensor}_prior"].log(
                cloud_message(columns, f"{frame_id}_prior", stamp_ns), log_time=now
            )
    if observation is not None and has_image and "camera" in observation.sensors:
        topics.drawn["boxes"].log(boxes_message(observation, at), log_time=now)
    if observation is not None:
        topics.clusters.log(clusters_message(observation, names.lidar, now), log_time=now)
        estimate = calibration.pairs.get("camera_lidar")
        for name, T, colour in (
            ("overlay", None if estimate is None else estimate.T, CALIBRATED),
            ("overlay_prior", priors.get("camera_lidar"), PRIOR),
        ):
            if T is not None and has_image and "camera" in observation.sensors:
                topics.drawn[name].log(edges_message(observation, T, colour, at), log_time=now)


# -- poses ------------------------------------------------------------------


def _transforms(
    calibration: ExportedCalibration, priors: Mapping[str, np.ndarray], stamp_ns: int
) -> list[fg.FrameTransform]:
    """Poses of child in parent: the calibrated tree, and the frames of the prior as children of it."""
    names = calibration.names
    edges = [(edge.parent, edge.child, edge.T) for edge in poses_of(calibration)]
    if "camera_lidar" in priors:
        edges.append((names.camera, f"{names.lidar}_prior", priors["camera_lidar"]))
    if "lidar_radar" in priors:
        edges.append((names.lidar, f"{names.radar}_prior", priors["lidar_radar"]))
    return [transform_message(parent, child, T, stamp_ns) for parent, child, T in edges]


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
        more = {"intensity": frame.lidar_intensity}
        return columns | {n: c for n, c in more.items() if c is not None}, frame.stamp_ns
    more = {"range_rate_mps": frame.radar_range_rate_mps, "power_db": frame.radar_power_db}
    return columns | {n: c for n, c in more.items() if c is not None}, frame.radar_stamp_ns


def cloud_message(columns: Mapping[str, np.ndarray], frame_id: str, stamp_ns: int) -> fg.PointCloud:
    """Points as a message; the columns have equal length."""
    points = np.stack([np.asarray(c, "<f4") for c in columns.values()], axis=1)
    fields = [fg.PackedElementField(name=n, offset=4 * i, type=_FLOAT32) for i, n in enumerate(columns)]
    origin = fg.Pose(
        position=fg.Vector3(x=0.0, y=0.0, z=0.0), orientation=fg.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    )
    return fg.PointCloud(
        timestamp=time_message(stamp_ns),
        frame_id=frame_id,
        pose=origin,
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
            pose=fg.Pose(
                position=fg.Vector3(x=c[0], y=c[1], z=c[2]), orientation=fg.Quaternion(x=0, y=0, z=0, w=1)
            ),
            size=fg.Vector3(x=s[0], y=s[1], z=s[2]),
            color=_colour(_BOX, 0.25),
        )
        for c, s in zip(((low + high) / 2).tolist(), (high - low).tolist(), strict=True)
    ]
    entity = fg.SceneEntity(timestamp=time_message(stamp_ns), frame_id=frame_id, id="clusters", cubes=cubes)
    return fg.SceneUpdate(entities=[entity])


def _colour(rgb: tuple[float, ...], opacity: float = 1.0) -> fg.Color:
    return fg.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=opacity)

"""Stage perceive: table frames to table observations, one vehicle-day, a row group at a time."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from pipeline.config import FleetConfig, PerceiveConfig
from pipeline.errors import ModelOutputError
from pipeline.geometry.cameras import camera_of
from pipeline.geometry.radar_grid import Scan
from pipeline.geometry.se3 import from_quaternion
from pipeline.perceive.camera import SemanticsSource, TopicSource, decode_grey, encode_png
from pipeline.perceive.depth_edges import lidar_edges
from pipeline.perceive.deskew import deskew_straight, velocity_ahead
from pipeline.perceive.drivable import DrivableSource, free_sector
from pipeline.perceive.ego_velocity import RadarMotion, Travel, radar_motion
from pipeline.perceive.ground import PointSource, find_ground
from pipeline.perceive.label_gradients import label_gradients
from pipeline.perceive.labels import ROAD_ID
from pipeline.perceive.lidar import cluster_boxes, cluster_objects, sample_uniformly
from pipeline.perceive.rejections import FrameReason, FrameRejectedError
from pipeline.perceive.road_markings import lidar_markings, road_contrast
from pipeline.perceive.tracks import EgoMotion, Tracks, TrackState, advance_tracks, measure_clusters
from pipeline.rigs import LidarTopics, OnnxSemantics, RadarTopics, TopicSemantics
from pipeline.store.views import frames_of
from pipeline.work import NothingUsable, Run, Task, Work
from schemas.calibrations import PAIRS
from schemas.faults import FAULTS
from schemas.frames import FRAMES, SAME_SCENE_NS, Frame
from schemas.observations import Observation

__all__ = ["perceive_frame", "work"]

_MIN_LIDAR_POINTS = 100  # less shows neither ground nor objects
# Among the manifest's kept: edges between neighbours, see README.
WITHOUT_ROWS: Final = "frames_without_lidar_rows"
# Likewise, of sweeps that no odometry de-skewed: moved by the radar's velocity, or left, for that was unknown.
BY_DOPPLER: Final = "frames_deskewed_by_doppler"
AS_LOGGED: Final = "frames_not_deskewed"
_PRIOR_FIELDS = [
    f"prior_{pair}_{part}" for pair in PAIRS for part in ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
]
_COPIED_FIELDS = [
    "frame_index", "log", "drive", "stamp_ns", "camera_stamp_ns", "radar_stamp_ns",
    "image_width_px", "image_height_px", "camera_model", "camera_K", "camera_D",
    "radar_power_db", "radar_has_elevation", *_PRIOR_FIELDS,
]  # fmt: skip

_XYZ, _EACH, _LABEL = np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32)
_BYTE = np.zeros(0, np.uint8)
# What an observation holds of a sensor that it goes without.
_NO_CAMERA: dict[str, Any] = {
    "labels_png": b"", "sky_fraction": 0.0, "drivable_fraction": 0.0, "road_contrast_png": None,
    "road_user_boxes_px": np.zeros((0, 4), np.float32), "road_user_classes": [], "road_user_scores": _EACH,
}  # fmt: skip
_NO_LIDAR: dict[str, Any] = {
    "lidar_map_xyz_m": _XYZ, "lidar_map_is_ground": _BYTE, "lidar_map_cluster": _LABEL,
    "lidar_cluster_centre_m": _XYZ, "lidar_cluster_min_m": _XYZ, "lidar_cluster_max_m": _XYZ,
    "lidar_edge_xyz_m": _XYZ, "lidar_edge_side": _BYTE, "lidar_edge_jump_m": _EACH,
    "lidar_edge_gap_rad": _EACH, "lidar_edge_points": _LABEL, "marking_xyz_m": _XYZ, "marking_z": _EACH,
    "ground_plane": None, "lidar_drivable_xyz_m": _XYZ,
}  # fmt: skip
_NO_RADAR: dict[str, Any] = {
    "radar_xyz_m": _XYZ, "radar_residual_mps": _EACH, "radar_motion": _BYTE, "radar_cluster": _LABEL,
    "radar_velocity_mps": None, "radar_velocity_cov": None,
    "radar_track_xyz_m": _XYZ, "radar_track_velocity_mps": _XYZ, "radar_track_id": _LABEL,
    "radar_track_age": _LABEL, "radar_track_points": _LABEL,
    "radar_drivable_azimuth_rad": _EACH, "radar_drivable_range_m": _EACH,
}  # fmt: skip


def work(task: Task) -> Work:
    """The partition of `observations` of a day's frames.

    A sensor that cannot be used is left out of its frame, a frame without two sensors is left out, counted by reason.
    Where none is left, the partition is empty and the
    outcome "refused".

    Raises:
        ConfigError: the vehicle or a model manifest is not as fleet.toml says.
        ModelError: a model does not do what its manifest says.
    """
    rig = task.fleet.rig_of(task.partition.vehicle)
    source, semantics_key = _source(rig.semantics, task.fleet)
    drivable, points = _drivable(rig.radar, task.fleet), _points(rig.lidar, task.fleet)
    for model in (drivable, points):
        semantics_key |= {} if model is None else model.provenance
    perceive = partial(
        perceive_frame,
        source=source,
        config=task.fleet.perceive,
        drivable=drivable,
        points=points,
        deskew=task.fleet.ingest.deskew,
    )
    return Work(
        (task.fleet.perceive, semantics_key),
        lambda run: _rows(task, perceive, run),
        nothing="no usable frame",
    )


def _rows(task: Task, perceive: Callable[..., Perceived], run: Run) -> Generator[Observation, None, None]:
    """The day's observations, a row group of frames in memory at a time."""
    total, state = task.inputs[FRAMES.name].rows, TrackState.empty()
    whole_ns = -SAME_SCENE_NS
    for seen, frame in enumerate(frames_of(task.lake, task.partition), 1):
        found: Perceived | None = None
        try:
            found = perceive(frame, tracks=state, alone=frame.stamp_ns - whole_ns > SAME_SCENE_NS)
        except FrameRejectedError as rejection:
            run.rejected[rejection.reason.value] += 1
        except ModelOutputError as err:
            raise NothingUsable(f"{FAULTS['model_output']}: {err}", "model_output") from err
        run.progress(seen, total, "perceive")
        if found is not None:
            state = found.tracks
            whole_ns = whole_ns if found.unusable else frame.stamp_ns
            run.kept.update([] if found.lidar_has_rows else [WITHOUT_ROWS])
            run.kept.update([] if found.deskew is None else [found.deskew])
            run.rejected.update(f"without_{sensor}_{why.value}" for sensor, why in found.unusable.items())
            yield found.observation


class Perceived(NamedTuple):
    """What one frame shows, and the radar tracks after it."""

    observation: Observation
    tracks: TrackState
    lidar_has_rows: bool  # a rosette has none
    deskew: str | None  # of a sweep that came as logged though its points have times: BY_DOPPLER or AS_LOGGED
    unusable: Mapping[
        str, FrameReason
    ] = {}  # sensors that the observation goes without, beside the frame's own


def perceive_frame(
    frame: Frame,
    source: SemanticsSource | None,
    config: PerceiveConfig,
    tracks: TrackState,
    drivable: DrivableSource | None = None,
    points: PointSource | None = None,
    *,
    deskew: bool = True,
    alone: bool = True,
) -> Perceived:
    """Everything that one frame shows, and the radar tracks carried on.

    Args:
        frame: the next of the day.
        source: of the camera's semantics; None for a rig without a camera.
        config: gates and sizes.
        tracks: from the frame before.
        drivable: network for the radar's drivable area, which remembers the scans before; None = geometry.
        points: model that tells what lidar points are; None = geometry.
        deskew: sweeps that ingest had no odometry for, by the radar's velocity.
        alone: no frame with all its sensors shows the same scene; else one that lacks a sensor is not worth having.

    Raises:
        ModelError: a model does not do what its manifest says.
        FrameRejectedError: a sensor cannot be used, and not two are left or the frame is not alone; `tracks` stay.
    """
    unusable = _unusable(frame)
    camera = _NO_CAMERA
    if "camera" in frame.sensors and "camera" not in unusable:
        try:
            camera = _perceive_camera(frame, source, config)
        except FrameRejectedError as why:
            unusable["camera"] = why.reason
    sensors = [sensor for sensor in frame.sensors if sensor not in unusable]
    if len(sensors) < 2 or (unusable and not alone):
        raise FrameRejectedError(next(iter(unusable.values())))
    # One generator per frame: the result does not depend on which frames came before.
    seed = [frame.stamp_ns & 0x7FFFFFFFFFFFFFFF, frame.frame_index]
    rng, own = np.random.default_rng(seed), None
    if deskew and not frame.lidar_deskewed and frame.lidar_time_s is not None:
        own = _motion(frame, config, np.random.default_rng([*seed, 1]))
    swept = frame if own is None else _deskewed(frame, own)
    lidar, has_rows = _perceive_lidar(swept, config, rng, points) if "lidar" in sensors else (_NO_LIDAR, True)
    motion = _motion(frame, config, rng) if own is None else own
    radar, state = _perceive_radar(frame, motion, tracks, drivable)
    copied = {name: getattr(frame, name) for name in _COPIED_FIELDS}
    observation = Observation(
        **copied,
        **camera,
        **lidar,
        **radar,
        sensors=sensors,
        ego_speed_mps=_ego_speed(frame, motion),
        ego_yaw_rate_radps=frame.ego_yaw_rate_radps,
        label_scale=config.label_scale,
    )
    how = None if own is None else AS_LOGGED if swept is frame else BY_DOPPLER
    return Perceived(observation, state, has_rows, how, unusable)


def _motion(frame: Frame, config: PerceiveConfig, rng: np.random.Generator) -> RadarMotion:
    return radar_motion(
        frame.radar_xyz_m, frame.radar_range_rate_mps, frame.radar_power_db, frame.doppler_period_mps,
        Travel(frame.ego_speed_mps, _heading(frame)), frame.radar_has_elevation, config, rng,
    )  # fmt: skip


def _deskewed(frame: Frame, motion: RadarMotion) -> Frame:
    """The frame with its points moved to the stamp by the radar's velocity; itself where that is unknown."""
    heading, time_s = _heading(frame), frame.lidar_time_s
    if motion.velocity_mps is None or heading is None or time_s is None:
        return frame
    velocity = velocity_ahead(motion.velocity_mps, heading)
    x, y, z = deskew_straight(frame.lidar_xyz_m, time_s, velocity).T
    return replace(frame, lidar_x_m=x, lidar_y_m=y, lidar_z_m=z, lidar_deskewed=True)


@dataclass(frozen=True, eq=False)
class _Sweep:
    """The finite points of one sweep."""

    xyz_m: np.ndarray
    intensity: np.ndarray | None
    ring: np.ndarray | None
    time_s: np.ndarray | None


def _source(
    wanted: TopicSemantics | OnnxSemantics | None, fleet: FleetConfig
) -> tuple[SemanticsSource | None, dict[str, Any]]:
    """Where semantics come from, and what of it belongs into the work key; nowhere without a camera."""
    if wanted is None:
        return None, {}
    if isinstance(wanted, TopicSemantics):
        keyed = wanted.model_dump(mode="json", include={"source", "label_set", "classes"})
        return TopicSource(wanted, fleet.perceive), keyed
    # onnxruntime loads only where it is used.
    from pipeline.perceive.models.source import ModelSource  # noqa: PLC0415

    models = ModelSource.load(wanted, fleet)
    return models, {"source": "onnx", **models.provenance}


def _unusable(frame: Frame) -> dict[str, FrameReason]:
    """Sensors of the frame whose columns say too little, and why; the image itself is not looked at."""
    found = {}
    if "camera" in frame.sensors:
        try:
            camera_of(frame)
        except ValueError:
            found["camera"] = FrameReason.CAMERA_MODEL
    finite = np.isfinite(frame.lidar_xyz_m).all(axis=1)
    if "lidar" in frame.sensors and finite.sum() < _MIN_LIDAR_POINTS:
        found["lidar"] = FrameReason.FEW_LIDAR_POINTS
    if "radar" in frame.sensors and not len(frame.radar_x_m):
        found["radar"] = FrameReason.FEW_RADAR_POINTS
    return found


def _perceive_camera(frame: Frame, source: SemanticsSource | None, config: PerceiveConfig) -> dict[str, Any]:
    """The columns of labels and road users.

    Raises:
        FrameRejectedError: no image, labels or detections that could be read.
    """
    assert source is not None, "only a rig with a camera has images"
    semantics = source.read(frame)
    grey = decode_grey(frame, config.label_scale)
    contrast = road_contrast(grey, semantics.labels == ROAD_ID)
    users = semantics.detections
    return {
        "labels_png": encode_png(semantics.labels),
        "sky_fraction": semantics.sky_fraction,
        "drivable_fraction": semantics.drivable_fraction,
        "road_user_boxes_px": users.boxes_px,
        "road_user_classes": users.classes,
        "road_user_scores": users.scores,
        "road_contrast_png": encode_png(contrast),
        "label_gradients": label_gradients(grey, semantics.labels),
    }


def _perceive_lidar(
    frame: Frame, config: PerceiveConfig, rng: np.random.Generator, points: PointSource | None
) -> tuple[dict[str, Any], bool]:
    """The lidar_*, marking_* and ground_* columns; whether the sweep has rows."""
    sweep = _finite_sweep(frame)
    xyz = sweep.xyz_m
    kind = None if points is None else points.kinds(xyz, sweep.intensity)
    ground = find_ground(xyz, config.ground_inlier_m, rng, kind)
    cluster = cluster_objects(xyz, ground.is_ground, config.cluster_eps_m, config.cluster_min_points)
    boxes = cluster_boxes(xyz, cluster)
    sample = sample_uniformly(xyz, config.voxel_m)
    edges = lidar_edges(xyz, sweep.ring, cluster, config)
    markings = lidar_markings(xyz, sweep.intensity, sweep.ring, ground.is_road)
    columns = {
        "lidar_map_xyz_m": xyz[sample],
        "lidar_map_is_ground": ground.is_ground[sample].astype(np.uint8),
        "lidar_map_cluster": cluster[sample],
        "lidar_map_time_s": None if sweep.time_s is None else sweep.time_s[sample],
        "lidar_cluster_centre_m": boxes.centre_m,
        "lidar_cluster_min_m": boxes.min_m,
        "lidar_cluster_max_m": boxes.max_m,
        "lidar_edge_xyz_m": edges.xyz_m,
        "lidar_edge_side": edges.side,
        "lidar_edge_jump_m": edges.jump_m,
        "lidar_edge_gap_rad": edges.gap_rad,
        "lidar_edge_points": edges.points,
        "marking_xyz_m": markings.xyz_m,
        "marking_z": markings.z,
        "ground_plane": ground.plane,
        "lidar_drivable_xyz_m": ground.drivable_xyz_m,
    }
    return columns, edges.has_rows


def _perceive_radar(
    frame: Frame, motion: RadarMotion, tracks: TrackState, drivable: DrivableSource | None
) -> tuple[dict[str, Any], TrackState]:
    """The radar_* columns but those copied from the frame; without a scan, tracks stay as they were."""
    xyz = frame.radar_xyz_m
    if not len(xyz):
        return _NO_RADAR, tracks
    returns = measure_clusters(xyz, motion.residual_mps, motion.cluster, frame.doppler_period_mps)
    state, found = advance_tracks(
        tracks, frame.radar_stamp_ns, frame.drive, _ego_motion(frame, motion), returns,
        frame.doppler_period_mps,
    )  # fmt: skip
    sector = (
        free_sector(xyz, motion.motion, frame.radar_has_elevation)
        if drivable is None
        else drivable.free_sector(_scan(frame, motion))
    )
    columns = {
        "radar_xyz_m": xyz,
        "radar_residual_mps": motion.residual_mps,
        "radar_motion": motion.motion,
        "radar_cluster": motion.cluster,
        "radar_velocity_mps": motion.velocity_mps,
        "radar_velocity_cov": motion.velocity_cov,
        **_track_columns(found),
        "radar_drivable_azimuth_rad": sector.azimuth_rad,
        "radar_drivable_range_m": sector.range_m,
    }
    return columns, state


def _drivable(radar: RadarTopics | None, fleet: FleetConfig) -> DrivableSource | None:
    if radar is None or radar.drivable is None:
        return None
    from pipeline.perceive.models.radar_drivable import RadarDrivable  # noqa: PLC0415 - as in _source

    return RadarDrivable.load(radar.drivable, fleet)


def _points(lidar: LidarTopics | None, fleet: FleetConfig) -> PointSource | None:
    if lidar is None or lidar.semantics is None:
        return None
    from pipeline.perceive.models.range_image import RangeImageSegmenter  # noqa: PLC0415 - as in _source

    return RangeImageSegmenter.load(lidar.semantics, fleet)


def _scan(frame: Frame, motion: RadarMotion) -> Scan:
    ego = _ego_motion(frame, motion)
    return Scan(
        frame.radar_stamp_ns,
        frame.drive,
        frame.radar_xyz_m,
        frame.radar_power_db,
        motion.residual_mps,
        motion.motion,
        frame.radar_has_elevation,
        ego.velocity_mps,
        ego.yaw_rate_radps,
    )


def _ego_motion(frame: Frame, motion: RadarMotion) -> EgoMotion:
    """The radar's velocity, or the odometry's speed where the scan shows no static world."""
    velocity = motion.velocity_mps
    if velocity is not None:
        return EgoMotion((float(velocity[0]), float(velocity[1])), frame.ego_yaw_rate_radps)
    speed = frame.ego_speed_mps
    return EgoMotion(None if speed is None else (speed, 0.0), frame.ego_yaw_rate_radps)


def _track_columns(tracks: Tracks) -> dict[str, np.ndarray]:
    return {
        "radar_track_xyz_m": tracks.xyz_m,
        "radar_track_velocity_mps": tracks.velocity_mps,
        "radar_track_id": tracks.identity,
        "radar_track_age": tracks.age,
        "radar_track_points": tracks.points,
    }


def _finite_sweep(frame: Frame) -> _Sweep:
    xyz = frame.lidar_xyz_m
    finite = np.isfinite(xyz).all(axis=1)
    # Of points as logged, nobody can tell whether the driver de-skewed them.
    times = frame.lidar_time_s if frame.lidar_deskewed else None
    columns = (frame.lidar_intensity, frame.lidar_ring, times)
    if finite.all():
        return _Sweep(xyz, *columns)
    return _Sweep(xyz[finite], *(None if column is None else column[finite] for column in columns))


def _ego_speed(frame: Frame, motion: RadarMotion) -> float | None:
    if frame.ego_speed_mps is not None or motion.velocity_mps is None:
        return frame.ego_speed_mps
    vx, vy = float(motion.velocity_mps[0]), float(motion.velocity_mps[1])
    heading = _heading(frame)
    if heading is None:  # frames without a prior are not calibrated; for other readers the radar looks ahead
        heading = 0.0
    return float(np.copysign(np.hypot(vx, vy), vx * np.cos(heading) + vy * np.sin(heading)))


def _heading(frame: Frame) -> float | None:
    """Azimuth in radar axes of the lidar's x axis, which points ahead, by the prior that the frame carries."""
    names = ("qw", "qx", "qy", "qz")
    q = [getattr(frame, f"prior_lidar_radar_{name}") for name in names]
    if any(v is None for v in q):
        return None
    ahead = from_quaternion(np.array(q, np.float64), np.zeros(3))[0, :3]
    return float(np.arctan2(ahead[1], ahead[0]))

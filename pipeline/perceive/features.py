"""Features of one image, sweep or scan: a function per kind of sensor, from captures to features."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from pipeline.core.config import PerceiveConfig
from pipeline.core.rows import take_rows
from pipeline.perceive.camera import CameraSemantics, FrameReason, SemanticsSource, decode_grey, encode_png
from pipeline.perceive.depth_edges import lidar_edges
from pipeline.perceive.drivable import DrivableSource, free_sector
from pipeline.perceive.earlier_greys import EarlierGreys
from pipeline.perceive.ego_velocity import RadarMotion
from pipeline.perceive.ground import PointSource, find_ground
from pipeline.perceive.image_motion import MotionReason
from pipeline.perceive.labels import ROAD_ID, VOID_ID, label_gradients
from pipeline.perceive.lidar import cluster_boxes, cluster_objects, sample_uniformly
from pipeline.perceive.road_markings import lidar_markings, road_contrast
from pipeline.perceive.tracks import EgoMotion, TrackState, advance_tracks, measure_clusters
from pipeline.rig.cameras import camera_of
from pipeline.rig.radar_grid import Scan as RadarScan
from schemas.captures import CameraColumns, Capture, Image, Scan, Sweep
from schemas.features import ImageFeatures, ScanFeatures, SweepFeatures
from schemas.moments import Moment
from schemas.observations import STEP_BELOW, STEP_RIGHT

__all__ = [
    "brightness_steps", "deskewed", "perceive_image", "perceive_scan", "perceive_sweep", "speed_of",
    "why_unusable",
]  # fmt: skip

_MIN_LIDAR_POINTS = 100  # less shows neither ground nor objects
_CAMERA = ("image_width_px", "image_height_px", "camera_model", "camera_K", "camera_D")
# Tried on the real car and on another simulator's day; a blur of 2 px, the strongest 3 % and runs of any length find
# the same pose to .05 deg.
_BLUR_PX = 1.0
_STRONGEST = 0.07  # share of the pixels
_SHORTEST_RUN_PX = 8
_GAP_PX = 4  # in a run, where another border crosses it
_LEAST_STEP = 0.5  # grey levels: in a plain image the strongest steps are rounding
_LEAST_ACROSS = 0.7  # of the step along the other axis: a step belongs to the axis that it crosses


def why_unusable(capture: Capture) -> FrameReason | None:
    """Reason why the columns of an image, a sweep or a scan are insufficient; the image is not decoded."""
    if isinstance(capture, CameraColumns):
        try:
            camera_of(capture)
        except ValueError:
            return FrameReason.CAMERA_MODEL
    if isinstance(capture, Sweep) and np.count_nonzero(_is_finite(capture)) < _MIN_LIDAR_POINTS:
        return FrameReason.FEW_LIDAR_POINTS
    if isinstance(capture, Scan) and not len(capture.radar_x_m):
        return FrameReason.FEW_RADAR_POINTS
    return None


def perceive_image(
    image: Image, source: SemanticsSource | None, earlier: EarlierGreys, config: PerceiveConfig
) -> tuple[ImageFeatures, MotionReason | None]:
    """Labels and road users of an image, or steps of its brightness without a source of semantics; and its motion.

    The reason is why the image shows no motion of the camera.

    Raises:
        FrameRejectedError: something cannot be read.
    """
    semantics = None if source is None else source.read(image)
    grey = decode_grey(image, config.label_scale)
    shown = _without_semantics(grey) if semantics is None else _with_semantics(grey, semantics)
    users = (None, None) if semantics is None else (semantics.labels, semantics.detections.boxes_px)
    motion, reason = earlier.columns(image, grey, *users)
    features = ImageFeatures(
        **_begin(image),
        **{name: getattr(image, name) for name in _CAMERA},
        label_scale=config.label_scale,
        **shown,
        **motion,
    )
    return features, reason


def _with_semantics(grey: UInt8[np.ndarray, "H W"], semantics: CameraSemantics) -> dict[str, Any]:
    users = semantics.detections
    return {
        "labels_png": encode_png(semantics.labels),
        "sky_fraction": semantics.sky_fraction,
        "drivable_fraction": semantics.drivable_fraction,
        "road_user_boxes_px": users.boxes_px,
        "road_user_classes": users.classes,
        "road_user_scores": users.scores,
        "road_contrast_png": encode_png(road_contrast(grey, semantics.labels == ROAD_ID)),
        "label_gradients": label_gradients(grey, semantics.labels),
    }


def _without_semantics(grey: UInt8[np.ndarray, "H W"]) -> dict[str, Any]:
    """Where the road is depends on the camera's pose, which features must not use: contrast is of the whole image."""
    return {
        "labels_png": encode_png(np.full(grey.shape, VOID_ID, np.uint8)),
        "sky_fraction": 0.0,
        "drivable_fraction": 0.0,
        "road_user_boxes_px": np.empty((0, 4), np.float32),
        "road_user_classes": [],
        "road_user_scores": np.empty(0, np.float32),
        "road_contrast_png": encode_png(road_contrast(grey, np.ones(grey.shape, bool))),
        "steps_png": encode_png(brightness_steps(grey)),
    }


def perceive_sweep(
    sweep: Sweep, config: PerceiveConfig, rng: np.random.Generator, points: PointSource | None
) -> tuple[SweepFeatures, bool]:
    """Ground, objects, edges and markings of a sweep; and whether it has rows, which a rosette has not."""
    is_finite = _is_finite(sweep)
    finite = sweep if is_finite.all() else take_rows(sweep, is_finite)
    xyz, intensity = finite.lidar_xyz_m, finite.lidar_intensity
    ring, time_s = finite.lidar_ring, finite.lidar_time_s
    kind = None if points is None else points.kinds(xyz, intensity)
    ground = find_ground(xyz, config.ground_inlier_m, rng, kind)
    cluster = cluster_objects(xyz, ground.is_ground, config.cluster_eps_m, config.cluster_min_points)
    boxes = cluster_boxes(xyz, cluster)
    sample = sample_uniformly(xyz, config.voxel_m)
    edges = lidar_edges(xyz, ring, cluster, config)
    markings = lidar_markings(xyz, intensity, ring, ground.is_road)
    features = SweepFeatures(
        **_begin(sweep),
        lidar_map_xyz_m=xyz[sample],
        lidar_map_is_ground=ground.is_ground[sample].astype(np.uint8),
        lidar_map_cluster=cluster[sample],
        # It is unknown whether the driver de-skewed the points that it logged.
        lidar_map_time_s=None if time_s is None or not sweep.lidar_deskewed else time_s[sample],
        lidar_cluster_centre_m=boxes.centre_m,
        lidar_cluster_min_m=boxes.min_m,
        lidar_cluster_max_m=boxes.max_m,
        lidar_edge_xyz_m=edges.xyz_m,
        lidar_edge_side=edges.side,
        lidar_edge_jump_m=edges.jump_m,
        lidar_edge_gap_rad=edges.gap_rad,
        lidar_edge_points=edges.points,
        marking_xyz_m=markings.xyz_m,
        marking_z=markings.z,
        ground_plane=ground.plane,
        lidar_drivable_xyz_m=ground.drivable_xyz_m,
    )
    return features, edges.has_rows


def perceive_scan(
    scan: Scan, moment: Moment, motion: RadarMotion, tracks: TrackState, drivable: DrivableSource | None
) -> tuple[ScanFeatures, TrackState]:
    """Motion, tracks and free sector of a scan, and the tracks after it."""
    xyz, ego = scan.radar_xyz_m, _ego_motion(moment, motion)
    returns = measure_clusters(xyz, motion.residual_mps, motion.cluster, scan.doppler_period_mps)
    state, found = advance_tracks(tracks, scan.stamp_ns, moment.drive, ego, returns, scan.doppler_period_mps)
    sector = (
        free_sector(xyz, motion.motion, scan.radar_has_elevation)
        if drivable is None
        else drivable.free_sector(
            RadarScan(
                scan.stamp_ns, moment.drive, xyz, scan.radar_power_db, motion.residual_mps, motion.motion,
                scan.radar_has_elevation, ego.velocity_mps, ego.yaw_rate_radps,
            )
        )
    )  # fmt: skip
    features = ScanFeatures(
        **_begin(scan), radar_xyz_m=xyz, radar_power_db=scan.radar_power_db,
        radar_residual_mps=motion.residual_mps, radar_motion=motion.motion, radar_cluster=motion.cluster,
        radar_has_elevation=scan.radar_has_elevation, radar_velocity_mps=motion.velocity_mps,
        radar_velocity_cov=motion.velocity_cov, radar_track_xyz_m=found.xyz_m,
        radar_track_velocity_mps=found.velocity_mps, radar_track_id=found.identity, radar_track_age=found.age,
        radar_track_points=found.points, radar_drivable_azimuth_rad=sector.azimuth_rad,
        radar_drivable_range_m=sector.range_m,
    )  # fmt: skip
    return features, state


def deskewed(sweep: Sweep, motion: RadarMotion, heading: float | None) -> Sweep:
    """The sweep, moved to its stamp by a radar's velocity if that is known.

    One scan gives the radar's velocity but not the car's yaw rate, because the lever arm is not logged. Points
    are therefore moved as if the car drove straight and level. In a turn the rotation between a point and the
    stamp remains: half a degree at 10 deg/s and half a sweep. Lidar-radar leaves such frames out.

    `heading` is the azimuth of the lidar's x axis in radar axes [rad].
    """
    time_s = sweep.lidar_time_s
    if motion.velocity_mps is None or heading is None or time_s is None:
        return sweep
    c, s, vx, vy = np.cos(heading), np.sin(heading), *motion.velocity_mps[:2].astype(np.float64)
    since_s = time_s.astype(np.float64)
    x_m = (sweep.lidar_x_m + since_s * (c * vx + s * vy)).astype(np.float32)
    y_m = (sweep.lidar_y_m + since_s * (c * vy - s * vx)).astype(np.float32)
    return replace(sweep, lidar_x_m=x_m, lidar_y_m=y_m, lidar_deskewed=True)


def speed_of(
    moment: Moment, motions: Mapping[str, RadarMotion], headings: Mapping[str, float | None]
) -> float | None:
    """The car's forward speed: by odometry, else by the first radar with a velocity."""
    known = (r for r, m in motions.items() if m.velocity_mps is not None)
    radar = next(known, None)
    if moment.ego_speed_mps is not None or radar is None:
        return moment.ego_speed_mps
    velocity = motions[radar].velocity_mps
    assert velocity is not None, "the radar was chosen for it"
    vx, vy = float(velocity[0]), float(velocity[1])
    # Moments without a prior are not calibrated; for other readers the radar looks ahead.
    heading = headings[radar] or 0.0
    return float(np.copysign(np.hypot(vx, vy), vx * np.cos(heading) + vy * np.sin(heading)))


def _is_finite(sweep: Sweep) -> Bool[np.ndarray, " N"]:
    return np.isfinite(sweep.lidar_x_m) & np.isfinite(sweep.lidar_y_m) & np.isfinite(sweep.lidar_z_m)


def _begin(capture: Capture) -> dict[str, Any]:
    return {"moment": capture.moment, "stamp_ns": capture.stamp_ns}


def _ego_motion(moment: Moment, motion: RadarMotion) -> EgoMotion:
    """The radar's velocity, or the odometry's speed where the scan shows no static world."""
    velocity = motion.velocity_mps
    if velocity is not None:
        return EgoMotion((float(velocity[0]), float(velocity[1])), moment.ego_yaw_rate_radps)
    speed = moment.ego_speed_mps
    return EgoMotion(None if speed is None else (speed, 0.0), moment.ego_yaw_rate_radps)


def brightness_steps(grey: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Bits of each pixel: STEP_RIGHT if brightness steps between it and the next one of its row; STEP_BELOW.

    They take the place of label borders for a camera without semantics. No step shows which side is nearer, so each
    is a border of both. Strong, long steps are taken: outlines of poles, cars and houses, kerbs and paint, not the
    grain of leaves and asphalt.
    """
    right, below = _steps_along_rows(grey), _steps_along_rows(grey.T).T
    return np.asarray(STEP_RIGHT * right + STEP_BELOW * below, np.uint8)


def _steps_along_rows(grey: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Where the step to the next pixel of the row is a maximum of the row, among the strongest, and in a long run."""
    blurred = cv2.GaussianBlur(np.ascontiguousarray(grey, np.float32), (0, 0), _BLUR_PX)
    along, across = np.zeros_like(blurred), np.zeros_like(blurred)
    along[:, :-1] = np.abs(np.diff(blurred, axis=1))
    across[:-1] = np.abs(np.diff(blurred, axis=0))
    is_step = along > max(float(np.quantile(along, 1 - _STRONGEST)), _LEAST_STEP)
    is_step[:, 1:-1] &= (along[:, 1:-1] >= along[:, :-2]) & (along[:, 1:-1] > along[:, 2:])
    is_step[:, [0, -1]] = False
    is_step &= along > _LEAST_ACROSS * across
    closed = cv2.morphologyEx(is_step.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((_GAP_PX + 1, 1), np.uint8))
    _, run, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    is_long = stats[:, cv2.CC_STAT_HEIGHT] >= _SHORTEST_RUN_PX
    is_long[0] = False  # the background
    return np.asarray(is_long[run])

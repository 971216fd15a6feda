"""Boxes, poles and painted lines on a road, traced ray by ray for a camera and a lidar, truth known.

Exact geometry and no noise model: what the camera-lidar terms must find is in the picture by construction. The world
is where the camera's clock says it is: with a time offset dt it has moved dt times the own speed (stamp_camera =
stamp_lidar + dt), and with a gap between the stamps by as much less. With a readout time the rows are seen one after
the other, the middle one at the image's time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from pipeline.core.config import PerceiveConfig
from pipeline.perceive.depth_edges import lidar_edges
from pipeline.perceive.features import brightness_steps
from pipeline.perceive.road_markings import lidar_markings, road_contrast
from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse
from schemas.observations import Observation
from tests.makers.solve_scenes import AXES, make_observation

GROUND_M = -1.8
ROAD_HALF_WIDTH_M = 6.0
ROAD, TERRAIN, VEGETATION, POLE, SKY, CAR = 0, 9, 8, 5, 10, 13
VOID = 255
# Brightness of what a camera without semantics sees.
GREY = np.full(256, 120, np.uint8)
GREY[[ROAD, TERRAIN, VEGETATION, POLE, SKY, CAR]] = 80, 105, 50, 150, 230, 30


@dataclass(frozen=True, eq=False)
class Rig:
    """A camera at label size times two, and a lidar's beams."""

    camera: Camera
    elevations_deg: np.ndarray
    azimuth_step_deg: float
    half_width_deg: float
    T_camera_lidar: np.ndarray
    has_ring: bool = True


T_TRUE = from_rotation_translation(
    exp_so3(np.array([0.012, -0.02, 0.015])) @ AXES, np.array([0.05, -0.2, -0.1])
)
PINHOLE = Camera(
    "plumb_bob", np.array([[900.0, 0, 449.5], [0, 900.0, 159.5], [0, 0, 1]]), np.zeros(0), 900, 320
)
FISHEYE = Camera(
    "equidistant", np.array([[600.0, 0, 449.5], [0, 600.0, 199.5], [0, 0, 1]]), np.zeros(4), 900, 400
)
SPARSE = Rig(PINHOLE, np.arange(-15.0, 16.0, 2.0), 0.2, 40.0, T_TRUE)
DENSE = Rig(FISHEYE, np.arange(-12.0, 6.0, 0.25), 0.25, 30.0, T_TRUE, has_ring=False)


def traced_day(
    rig: Rig, frames: int, seed: int, dt_s: float = 0.0, *, reflective: bool = True,
    gaps_s: Sequence[float] = (), readout_s: float = 0.0,
) -> list[Observation]:  # fmt: skip
    """Observations of independent scenes, six frames to a drive, every third standing; gaps of images to sweeps.

    Traced once a process.
    """
    return list(_traced(rig, frames, seed, dt_s, reflective, tuple(gaps_s) or (0.0,) * frames, readout_s))


@cache
def _traced(rig, frames, seed, dt_s, reflective, gaps_s, readout_s):
    rng = np.random.default_rng(seed)
    speeds = [0.0 if i % 3 == 0 else float(rng.uniform(5, 25)) for i in range(frames)]
    return [
        traced_frame(rig, rng, i, speeds[i], dt_s, gap_s, reflective=reflective, readout_s=readout_s)
        for i, gap_s in enumerate(gaps_s)
    ]


def traced_frame(
    rig: Rig, rng: np.random.Generator, index: int, speed_mps: float, dt_s: float, gap_s: float, *, reflective:
    bool, readout_s: float = 0.0,
) -> Observation:  # fmt: skip
    """One scene, seen by both sensors."""
    boxes, labels_of_box = scatter_boxes(rng)
    phase = rng.uniform(0, 12)
    label_camera = rig.camera.scaled(0.5)
    u, v = np.meshgrid(
        np.arange(label_camera.width_px, dtype=float), np.arange(label_camera.height_px, dtype=float)
    )
    rays = label_camera.unproject(np.stack([u, v], -1).reshape(-1, 2))
    T_lidar_camera = inverse(rig.T_camera_lidar)
    # The image is dt older on the lidar's clock than its stamp: the car stood so much behind.
    late_s = ((v.ravel() + 0.5) / label_camera.height_px - 0.5) * readout_s
    way_m = speed_mps * (dt_s - gap_s - late_s)
    origin = T_lidar_camera[:3, 3] - way_m[:, None] * np.array([1.0, 0, 0])
    _, what, paint = trace(origin, rays @ T_lidar_camera[:3, :3].T, boxes, labels_of_box, phase)
    labels = what.reshape(u.shape).astype(np.uint8)
    grey = np.where(what == ROAD, np.where(paint, 200, 80), 120).reshape(u.shape).astype(np.uint8)
    grey = cv2.GaussianBlur(grey, (3, 3), 0.7)

    xyz, ring, cluster, is_ground, intensity = sweep(rig, boxes, labels_of_box, phase)
    edges = lidar_edges(xyz, ring, cluster, PerceiveConfig())
    marks = lidar_markings(xyz, intensity if reflective else None, ring, is_ground)
    made = make_observation(rng, index, index // 6, float(index))
    return replace(
        made, camera_stamp_ns=made.stamp_ns + round(gap_s * 1e9),
        image_width_px=rig.camera.width_px, image_height_px=rig.camera.height_px,
        camera_model=rig.camera.model, camera_K=rig.camera.K, camera_D=rig.camera.D,
        ego_speed_mps=speed_mps, ego_yaw_rate_radps=None, radar_velocity_mps=None,
        labels_png=cv2.imencode(".png", labels)[1].tobytes(), label_scale=0.5,
        road_contrast_png=cv2.imencode(".png", road_contrast(grey, labels == ROAD))[1].tobytes(),
        lidar_map_xyz_m=xyz, lidar_map_is_ground=is_ground.astype(np.uint8), lidar_map_cluster=cluster,
        lidar_edge_xyz_m=edges.xyz_m, lidar_edge_side=edges.side, lidar_edge_jump_m=edges.jump_m,
        lidar_edge_gap_rad=edges.gap_rad, lidar_edge_points=edges.points,
        marking_xyz_m=marks.xyz_m, marking_z=marks.z, ground_plane=np.array([0.0, 0, 1, -GROUND_M]),
    )  # fmt: skip


def without_labels(day: Sequence[Observation]) -> list[Observation]:
    """The same scenes as a camera without semantics shows them: steps of brightness, no labels, no road users."""
    return [_without_labels(o) for o in day]


def _without_labels(o: Observation) -> Observation:
    labels, contrast = (
        cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
        for png in (o.labels_png, o.road_contrast_png)
    )
    grey = GREY[labels]
    grey[contrast > 60] = 200  # paint
    grey = cv2.GaussianBlur(grey, (3, 3), 0.7)
    none = {"road_user_boxes_px": np.zeros((0, 4), np.float32), "road_user_classes": [],
            "road_user_scores": np.zeros(0, np.float32), "sky_fraction": 0.0, "drivable_fraction": 0.0}  # fmt: skip
    return replace(
        o, **none,
        labels_png=cv2.imencode(".png", np.full(labels.shape, VOID, np.uint8))[1].tobytes(),
        steps_png=cv2.imencode(".png", brightness_steps(grey))[1].tobytes(),
        road_contrast_png=cv2.imencode(".png", road_contrast(grey, np.ones(grey.shape, bool)))[1].tobytes(),
        lidar_drivable_xyz_m=free_ground(o).astype(np.float32),
    )  # fmt: skip


def free_ground(o: Observation) -> np.ndarray:
    """Road on a 1 m grid, as far as no object stands in the way, lidar frame."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(4.0, 60), np.arange(-5.0, 6)))
    objects = o.lidar_map_xyz_m[o.lidar_map_is_ground == 0]
    reach_m = np.full(181, np.inf)
    np.minimum.at(reach_m, _degrees_of(objects[:, 0], objects[:, 1]), np.hypot(objects[:, 0], objects[:, 1]))
    is_free = np.hypot(x, y) < reach_m[_degrees_of(x, y)]
    return np.column_stack([x, y, np.full(len(x), GROUND_M)])[is_free]


def _degrees_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.round(np.degrees(np.arctan2(y, x))).astype(int) + 90


def scatter_boxes(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (lower, upper corner) and their labels: cars, poles, and a hedge far behind."""
    cars = [(rng.uniform(8, 40), rng.uniform(-12, 12)) for _ in range(7)]
    poles = [(rng.uniform(7, 35), rng.choice([-1, 1]) * rng.uniform(4, 14)) for _ in range(8)]
    boxes = [((x, y - 0.9), (x + 4.0, y + 0.9), 1.6, CAR) for x, y in cars]
    boxes += [((x, y - 0.15), (x + 0.3, y + 0.15), 5.0, POLE) for x, y in poles]
    near, far, height, label = zip(*boxes, ((60.0, -80), (62.0, 80), 3.0, VEGETATION), strict=True)
    ground = np.full(len(label), GROUND_M)
    return np.stack([np.c_[near, ground], np.c_[far, ground + height]]), np.array(label)


def trace(
    origin: np.ndarray, direction: np.ndarray, boxes: np.ndarray, labels_of_box: np.ndarray, phase: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range (inf = sky), label and paint of what each ray meets first."""
    safe = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    t0, t1 = ((corner[:, None] - origin) / safe for corner in boxes)
    near, far = np.minimum(t0, t1).max(-1), np.maximum(t0, t1).min(-1)
    to_box = np.where((near <= far) & (near > 0), near, np.inf)
    to_ground = np.where(safe[:, 2] < 0, (GROUND_M - origin[..., 2]) / safe[:, 2], np.inf)
    to_ground = np.where(to_ground < 90.0, to_ground, np.inf)
    first = to_box.argmin(0)
    box = to_box.min(0)
    distance = np.minimum(box, to_ground)
    at = origin + np.where(np.isfinite(distance), distance, 0.0)[:, None] * direction
    is_ground = (to_ground < box) & np.isfinite(distance)
    on_road = is_ground & (np.abs(at[:, 1]) < ROAD_HALF_WIDTH_M)
    label = np.where(
        np.isfinite(distance),
        np.where(is_ground, np.where(on_road, ROAD, TERRAIN), labels_of_box[first]),
        SKY,
    )
    dashed = (np.abs(at[:, 1]) < 0.1) & ((at[:, 0] + phase) % 12 < 6)
    solid = np.abs(np.abs(at[:, 1]) - 4.5) < 0.1
    arrow = (np.abs(at[:, 1] - 2.2) < 0.5) & ((at[:, 0] + phase) % 17 < 1.0)
    return distance, label, on_road & (dashed | solid | arrow)


def sweep(
    rig: Rig, boxes: np.ndarray, labels_of_box: np.ndarray, phase: float
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, np.ndarray, np.ndarray]:
    """Points, ring, cluster, ground mask and intensity of one sweep."""
    azimuth = np.radians(np.arange(-rig.half_width_deg, rig.half_width_deg, rig.azimuth_step_deg))
    e, a = np.meshgrid(np.radians(rig.elevations_deg), azimuth, indexing="ij")
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    distance, label, paint = trace(np.zeros(3), rays, boxes, labels_of_box, phase)
    ring = np.repeat(np.arange(len(rig.elevations_deg)), len(azimuth)).astype(np.uint16)
    hit = np.isfinite(distance)
    xyz = (rays * np.where(hit, distance, 0.0)[:, None])[hit].astype(np.float32)
    inside = [np.all((xyz > lo - 0.05) & (xyz < hi + 0.05), axis=1) for lo, hi in zip(*boxes, strict=True)]
    is_ground = np.isin(label[hit], (ROAD, TERRAIN))
    cluster = np.where(is_ground, -1, np.argmax(inside, axis=0)).astype(np.int32)
    intensity = np.where(paint, 90.0, 20.0)[hit].astype(np.float32)
    intensity += np.random.default_rng(0).normal(0, 2.0, len(intensity)).astype(np.float32)
    return xyz, ring[hit] if rig.has_ring else None, cluster, is_ground, intensity

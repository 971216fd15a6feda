"""Small days of observations with a known truth, for the tests of objective, solve, verify and calibrate.

Boxes on a road, seen exactly by all three sensors: no noise model, for these tests ask whether losses and
optimiser do what they should, not how well they do on the road.
"""

import cv2
import numpy as np

from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import changed, exp_so3, from_rotation_translation, inverse, transform_points
from schemas.calibrations import SENSORS
from schemas.observations import EDGE_LEFT, EDGE_RIGHT, Observation

AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # camera axes of lidar axes
T_CAMERA_LIDAR = from_rotation_translation(
    exp_so3(np.array([0.01, -0.02, 0.015])) @ AXES, np.array([0.05, -0.2, -0.1])
)
T_LIDAR_RADAR = from_rotation_translation(
    exp_so3(np.array([0.01, 0.005, -0.03])), np.array([0.6, 0.05, -0.9])
)
PRIORS = {"camera_lidar": T_CAMERA_LIDAR, "lidar_radar": T_LIDAR_RADAR}
TRUTH = PRIORS | {"camera_radar": T_CAMERA_LIDAR @ T_LIDAR_RADAR}
CAMERA = Camera(
    "plumb_bob", np.array([[500.0, 0, 319.5], [0, 500.0, 159.5], [0, 0, 1]]), np.zeros(0), 640, 320
)
LABEL_SCALE = 0.5
GROUND_M = -1.7
HALF_SIZE_M = np.array([2.0, 0.9, 0.8])
ROAD, VEGETATION, SKY, CAR = 0, 8, 10, 13
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


def turned(T: np.ndarray, axis: int, degrees: float) -> np.ndarray:
    """T_parent_child with the child turned in its place about an axis of the parent."""
    return changed(T, np.radians(degrees) * np.eye(6)[axis])


def make_day(
    frames: int = 24, seed: int = 0, step_s: float = 1.0, per_drive: int = 8, **changes
) -> list[Observation]:
    """Observations of `frames` independent scenes, `step_s` apart, a new drive every `per_drive` frames."""
    rng = np.random.default_rng(seed)
    return [
        make_observation(rng, i, i // per_drive, (i * step_s + i // per_drive * 30.0), **changes)
        for i in range(frames)
    ]


def make_observation(
    rng: np.random.Generator, index: int, drive: int, stamp_s: float, **changes
) -> Observation:
    """One scene; `changes` replace columns."""
    centres = scatter_objects(rng)
    labels, boxes = draw(centres)
    clusters = [centres[k] + surface(rng) for k in range(len(centres))]
    ground = np.stack([rng.uniform(4, 40, 300), rng.uniform(-3.5, 3.5, 300), np.full(300, GROUND_M)], -1)
    cells = np.stack([*(a.ravel() + 0.5 for a in np.meshgrid(np.arange(4.0, 40), np.arange(-4.0, 4)))], -1)
    drivable = np.column_stack([cells, np.full(len(cells), GROUND_M)])
    azimuth, reach = free_sector(transform_points(inverse(T_LIDAR_RADAR), drivable))
    cloud = np.concatenate([*clusters, ground])
    edges, sides = silhouettes(centres)
    tracks = transform_points(inverse(T_LIDAR_RADAR), centres)
    moving = np.repeat(tracks, 3, axis=0) + rng.normal(size=(3 * len(tracks), 3)) * 0.1
    static = transform_points(inverse(T_LIDAR_RADAR), cloud[rng.integers(0, len(cloud), 60)])
    stamp_ns = int((1_000 + stamp_s) * 1e9)
    n = len(centres)
    values = {
        "frame_index": index, "log": "a.mcap", "drive": drive,
        "stamp_ns": stamp_ns, "camera_stamp_ns": stamp_ns + 1_000_000, "radar_stamp_ns": stamp_ns - 1_000_000,
        "image_width_px": CAMERA.width_px, "image_height_px": CAMERA.height_px,
        "camera_model": CAMERA.model, "camera_K": CAMERA.K, "camera_D": CAMERA.D,
        "priors": PRIORS, "sensors": list(SENSORS),
        "ego_speed_mps": 10.0, "ego_yaw_rate_radps": None,
        "labels_png": cv2.imencode(".png", labels)[1].tobytes(), "label_scale": LABEL_SCALE,
        "sky_fraction": float(np.mean(labels == SKY)), "drivable_fraction": float(np.mean(labels == ROAD)),
        "road_user_boxes_px": boxes.astype(np.float32), "road_user_classes": ["car"] * n,
        "road_user_scores": np.ones(n, np.float32), "road_contrast_png": None,
        "lidar_map_xyz_m": cloud.astype(np.float32),
        "lidar_map_is_ground": np.r_[np.zeros(len(cloud) - 300), np.ones(300)].astype(np.uint8),
        "lidar_map_cluster": np.r_[np.repeat(np.arange(n), len(clusters[0])), np.full(300, -1)].astype(np.int32),
        "lidar_cluster_centre_m": centres.astype(np.float32),
        "lidar_cluster_min_m": (centres - HALF_SIZE_M).astype(np.float32),
        "lidar_cluster_max_m": (centres + HALF_SIZE_M).astype(np.float32),
        "lidar_edge_xyz_m": edges.astype(np.float32), "lidar_edge_side": sides,
        "lidar_edge_jump_m": np.full(len(edges), 9.0, np.float32),
        "lidar_edge_gap_rad": np.full(len(edges), 0.003, np.float32),
        "lidar_edge_points": np.full(len(edges), 80, np.int32),
        "marking_xyz_m": np.zeros((0, 3), np.float32), "marking_z": np.zeros(0, np.float32),
        "ground_plane": np.array([0, 0, 1.0, -GROUND_M]), "lidar_drivable_xyz_m": drivable.astype(np.float32),
        "radar_xyz_m": np.concatenate([moving, static]).astype(np.float32), "radar_power_db": None,
        "radar_residual_mps": np.r_[np.full(3 * n, 5.0), np.zeros(len(static))].astype(np.float32),
        "radar_motion": np.r_[np.ones(3 * n), np.zeros(len(static))].astype(np.uint8),
        "radar_cluster": np.r_[np.repeat(np.arange(n), 3), np.full(len(static), -1)].astype(np.int32),
        "radar_has_elevation": True,
        "radar_velocity_mps": np.array([10.0, 0, 0]), "radar_velocity_cov": np.eye(3) * 0.01,
        "radar_track_xyz_m": tracks.astype(np.float32), "radar_track_velocity_mps": np.ones((n, 3), np.float32),
        "radar_track_id": np.arange(n, dtype=np.int32), "radar_track_age": np.full(n, 3, np.int32),
        "radar_track_points": np.full(n, 3, np.int32),
        "radar_drivable_azimuth_rad": azimuth.astype(np.float32), "radar_drivable_range_m": reach.astype(np.float32),
    }  # fmt: skip
    return Observation(**(values | changes))


def scatter_objects(rng: np.random.Generator, count: int = 6) -> np.ndarray:
    """Centres of cars ahead, apart from each other in azimuth so that masks do not merge, lidar frame."""
    azimuth = np.linspace(-0.42, 0.42, count) + rng.uniform(-0.03, 0.03, count)
    distance = rng.uniform(9, 32, count)
    height = rng.uniform(-0.3, 0.8, count)  # hills: objects at one height would leave pitch and tz alike
    return np.stack(
        [distance, distance * np.tan(azimuth), np.full(count, GROUND_M + HALF_SIZE_M[2]) + height], -1
    )


def surface(rng: np.random.Generator, points: int = 80) -> np.ndarray:
    """Points on the rear face and both sides of a car, about its centre."""
    p = rng.uniform(-1, 1, (points, 3)) * HALF_SIZE_M
    rear = np.arange(points) % 2 == 0
    p[rear, 0] = -HALF_SIZE_M[0]
    p[~rear, 1] = np.sign(p[~rear, 1]) * HALF_SIZE_M[1]
    return p


def silhouettes(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on the upright edges that bound each car to the left and right, and where the car lies from them."""
    points, sides = [], []
    for centre in centres:
        corners = centre + CORNERS * HALF_SIZE_M
        azimuth = np.arctan2(corners[:, 1], corners[:, 0])
        for corner, side in ((corners[azimuth.argmax()], EDGE_RIGHT), (corners[azimuth.argmin()], EDGE_LEFT)):
            heights = centre[2] + np.linspace(-0.7, 0.7, 8)
            points.append(np.column_stack([np.tile(corner[:2], (8, 1)), heights]))
            sides += [side] * 8
    return np.concatenate(points), np.array(sides, np.uint8)


def draw(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels at half size (sky, plants at the horizon's sides, road, cars) and the cars' boxes in full pixels."""
    camera = CAMERA.scaled(LABEL_SCALE)
    labels = np.full((camera.height_px, camera.width_px), ROAD, np.uint8)
    labels[: camera.height_px // 2] = SKY
    boxes = []
    for centre in centres:
        corners = transform_points(T_CAMERA_LIDAR, centre + CORNERS * HALF_SIZE_M)
        uv = camera.project(corners)[0]
        cv2.fillConvexPoly(labels, cv2.convexHull(np.round(uv).astype(np.int32)), CAR)
        middle = CAMERA.project(transform_points(T_CAMERA_LIDAR, centre[None]))[0][0]
        full = CAMERA.project(corners)[0]
        half = np.maximum(np.abs(full - middle).max(axis=0), 2)  # centred on the car's centre
        boxes.append([*(middle - half), *(middle + half)])
    return labels, np.array(boxes)


def free_sector(cells_radar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Free range per azimuth bin that contains the cells and little more."""
    azimuth = np.arctan2(cells_radar[:, 1], cells_radar[:, 0])
    distance = np.hypot(cells_radar[:, 0], cells_radar[:, 1])
    edges = np.linspace(-0.75, 0.75, 76)
    index = np.digitize(azimuth, edges) - 1
    reach = np.array([distance[index == k].max(initial=0.0) for k in range(75)])
    return (edges[:-1] + edges[1:]) / 2, reach

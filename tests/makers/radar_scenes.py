"""Streets seen by a lidar, a noisy radar and a camera's boxes, with a known truth: for the radar half of `joint`.

Poles, house fronts, parked and moving cars; the car drives at various speeds, and the radar's clock is off.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.rig.se3 import (
    exp_so3,
    from_rotation_translation,
    from_spherical,
    inverse,
    to_spherical,
    transform_points,
)
from schemas.observations import EDGE_ABOVE, Observation
from tests.makers.solve_scenes import CAMERA, T_CAMERA_LIDAR, make_day

T_LIDAR_RADAR = from_rotation_translation(exp_so3(np.array([0.02, -0.01, 0.03])), np.array([0.8, 0.1, -0.7]))
DT_S = 0.021  # stamp_lidar = stamp_radar + dt
SIGMA = np.array([np.radians(0.3), np.radians(1.5), 0.10])
GROUND_M = -1.7
BEAM_GAP_RAD = np.radians(0.4)


def street_day(
    frames: int = 30, seed: int = 0, *, dt_s: float = DT_S, elevation: bool = True, gaps_s: Sequence[float] = (),
    **changes,
) -> list[Observation]:  # fmt: skip
    """A day of streets; `changes` replace columns of every frame; `gaps_s` are radar stamps less the sweeps'."""
    rng = np.random.default_rng(seed)
    base = make_day(frames=frames, seed=seed, per_drive=3)
    if len(gaps_s):
        stamps = [o.stamp_ns + round(gap * 1e9) for o, gap in zip(base, gaps_s, strict=True)]
        base = [replace(o, radar_stamp_ns=ns) for o, ns in zip(base, stamps, strict=True)]
    return [replace(o, **(_street(rng, o, dt_s, elevation) | changes)) for o in base]


def _street(rng: np.random.Generator, o: Observation, dt_s: float, elevation: bool) -> dict:
    cars = np.stack([rng.uniform(8, 40, 7), rng.uniform(-9, 9, 7), np.full(7, GROUND_M + 0.75)], -1)
    moving = np.arange(7) < 3
    world = np.concatenate([_poles(rng), _fronts(rng), *(_car(rng, c) for c in cars[~moving])])
    ground = np.stack([rng.uniform(3, 50, 1500), rng.uniform(-12, 12, 1500), np.full(1500, GROUND_M)], -1)
    cloud = np.concatenate([world, ground, *(_car(rng, c) for c in cars[moving])])
    speed = rng.uniform(0, 16)
    velocity = T_LIDAR_RADAR[:3, :3].T @ np.array([speed, 0.0, 0.0])
    tau = (o.radar_stamp_ns - o.stamp_ns) * 1e-9 + dt_s
    seen = world[rng.integers(0, len(world), 220)]
    static = _measure(rng, transform_points(inverse(T_LIDAR_RADAR), seen) - velocity * tau)
    rate = rng.uniform(3, 9, 3)
    movers = []
    for centre, over_ground in zip(cars[moving], rate, strict=True):
        p = _echoes(rng, centre)
        u = p / np.linalg.norm(p, axis=1, keepdims=True)
        movers.append(_measure(rng, p + (over_ground - u @ velocity)[:, None] * u * tau))
    parked = [_measure(rng, _echoes(rng, centre) - velocity * tau) for centre in cars[~moving]]
    clutter = _measure(rng, from_spherical(rng.uniform([-0.9, -0.1, 4], [0.9, 0.1, 50], (40, 3))))
    radar = np.concatenate([static, *parked, clutter, *movers])
    if not elevation:
        radar = from_spherical(to_spherical(radar) * [1, 0, 1])
    n = len(radar) - 18
    boxes, inside = _boxes(cars)
    return {
        "lidar_map_xyz_m": cloud.astype(np.float32),
        "lidar_map_is_ground": np.zeros(len(cloud), np.uint8),
        "lidar_map_cluster": np.full(len(cloud), -1, np.int32),
        "lidar_cluster_centre_m": cars.astype(np.float32),
        "lidar_cluster_min_m": (cars - [2.1, 0.9, 0.75]).astype(np.float32),
        "lidar_cluster_max_m": (cars + [2.1, 0.9, 0.75]).astype(np.float32),
        "lidar_edge_side": np.full(len(o.lidar_edge_side), EDGE_ABOVE, np.uint8),
        "lidar_edge_gap_rad": np.full(len(o.lidar_edge_side), BEAM_GAP_RAD, np.float32),
        "road_user_boxes_px": boxes.astype(np.float32),
        "road_user_classes": ["car"] * int(inside.sum()),
        "road_user_scores": np.ones(int(inside.sum()), np.float32),
        "radar_xyz_m": radar.astype(np.float32),
        "radar_residual_mps": np.r_[np.zeros(n), np.repeat(rate, 6)].astype(np.float32),
        "radar_motion": np.r_[np.zeros(n), np.ones(18)].astype(np.uint8),
        "radar_cluster": np.r_[np.full(n, -1), np.repeat(np.arange(3), 6)].astype(np.int32),
        "radar_has_elevation": elevation,
        "radar_velocity_mps": velocity,
        "ego_speed_mps": float(speed),
    }


def _measure(rng: np.random.Generator, points_radar: np.ndarray) -> np.ndarray:
    return from_spherical(to_spherical(points_radar) + rng.normal(size=(len(points_radar), 3)) * SIGMA)


def _echoes(rng: np.random.Generator, car: np.ndarray) -> np.ndarray:
    """Where six echoes of a car come from, radar frame."""
    return transform_points(inverse(T_LIDAR_RADAR), car + rng.normal(0, 0.4, (6, 3)) * [1, 1, 0.5])


def _poles(rng: np.random.Generator) -> np.ndarray:
    foot = np.stack([rng.uniform(5, 45, 14), rng.choice([-1, 1], 14) * rng.uniform(5, 12, 14)], -1)
    heights = np.arange(GROUND_M, 2.5, 0.25)
    return np.concatenate([np.column_stack([np.tile(f, (len(heights), 1)), heights]) for f in foot])


def _fronts(rng: np.random.Generator) -> np.ndarray:
    """Walls along the road, broken and with corners, up to 4 m high."""
    pieces = []
    for side in (-1, 1):
        start = 4.0
        while start < 48:
            length, offset = rng.uniform(4, 9), side * rng.uniform(10, 15)
            x = rng.uniform(start, start + length, 120)
            pieces.append(np.column_stack([x, np.full(120, offset), rng.uniform(GROUND_M, 2.3, 120)]))
            y = offset + side * rng.uniform(0, 4, 60)
            pieces.append(np.column_stack([np.full(60, start), y, rng.uniform(GROUND_M, 2.3, 60)]))
            start += length + rng.uniform(1, 4)
    return np.concatenate(pieces)


def _car(rng: np.random.Generator, centre: np.ndarray) -> np.ndarray:
    p = rng.uniform(-1, 1, (60, 3)) * [2.1, 0.9, 0.75]
    rear = np.arange(60) % 2 == 0
    p[rear, 0], p[~rear, 1] = -2.1, -np.sign(centre[1]) * 0.9
    return centre + p


def _boxes(cars: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x, y, z] for x in (-2.1, 2.1) for y in (-0.9, 0.9) for z in (-0.75, 0.75)])
    uv = np.stack([CAMERA.project(transform_points(T_CAMERA_LIDAR, c + corners))[0] for c in cars])
    lower, upper = uv.min(1), uv.max(1)
    inside = (lower > 4).all(1) & (upper < [CAMERA.width_px - 5, CAMERA.height_px - 5]).all(1)
    return np.concatenate([lower, upper], 1)[inside], inside

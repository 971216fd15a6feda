"""Streets of known truth for a radar that drives along them: Doppler in radar axes, the road in lidar axes."""

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
from tests.makers.solve_scenes import make_day

GROUND_M, SPEED_MPS = -1.7, 14.0
T_LIDAR_RADAR = from_rotation_translation(exp_so3(np.array([0.02, -0.02, 0.03])), np.array([0.8, 0.1, -0.7]))
TEMPLATE = make_day(frames=1)[0]


def scene(
    rng, *, T=T_LIDAR_RADAR, noise_deg=2.0, mirrored=0.0, displaced=0.0, bias_deg=0.0, curvature=0.0,
    speed=SPEED_MPS,
):  # fmt: skip
    """One frame: poles and kerbs; elevations are noisy, some are those of the image in the road, all may be off.

    `displaced` is the share that is seen, in direction and Doppler, anywhere between the thing and its image.
    """
    foot = np.stack([rng.uniform(8, 45, 40), rng.choice([-1, 1], 40) * rng.uniform(5, 14, 40)], -1)
    foot = np.concatenate([foot, foot @ [[0.0, -1], [1, 0]]])  # a street that crosses
    top = rng.uniform(0.1, 6.0, len(foot))
    heights = np.arange(0.0, 6.0, 0.2)
    poles = np.concatenate(
        [np.column_stack([np.tile(f, (30, 1)), heights])[heights < t] for f, t in zip(foot, top, strict=True)]
    )
    ground = np.column_stack([rng.uniform(-2, 40, 1500), rng.uniform(-12, 12, 1500), np.zeros(1500)])
    world = poles[rng.integers(0, len(poles), 400)]
    height = world[:, 2:].copy()
    for p in (poles, ground, world):
        p[:, 2] += GROUND_M + 0.5 * curvature * p[:, 0] ** 2
    velocity = T[:3, :3].T @ [speed, 0.0, 0.0]
    aer = to_spherical(transform_points(inverse(T), world))
    image = to_spherical(transform_points(inverse(T), world - 2 * height * [0.0, 0.0, 1.0]))
    # Sent and received by way of the road or not: the Doppler is the mean of both ways, the angle that of the second.
    there, back = rng.random((2, len(world), 1)) < mirrored
    ways = [
        np.where(w, from_spherical(image) / image[:, 2:], from_spherical(aer) / aer[:, 2:])
        for w in (there, back)
    ]
    if displaced:
        seen_m = height * np.where(
            rng.random(height.shape) < displaced, rng.uniform(-1, 1, height.shape), 1.0
        )
        aer = to_spherical(transform_points(inverse(T), world - (height - seen_m) * [0.0, 0.0, 1.0]))
    rate = -0.5 * (ways[0] + ways[1]) @ velocity + rng.normal(0, 0.06, len(world))
    aer[:, 1] = np.where(back[:, 0], image[:, 1], aer[:, 1])
    aer += np.radians([0.3, noise_deg, 0.0]) * rng.normal(size=aer.shape) + np.radians([0.0, bias_deg, 0.0])
    radar = from_spherical(aer).astype(np.float32)
    u = radar / np.linalg.norm(radar, axis=1, keepdims=True)
    n = len(radar)
    return replace(
        TEMPLATE, radar_stamp_ns=TEMPLATE.stamp_ns, radar_xyz_m=radar,
        radar_residual_mps=(rate + u @ velocity).astype(np.float32), radar_motion=np.zeros(n, np.uint8),
        radar_cluster=np.full(n, -1, np.int32), radar_velocity_mps=velocity,
        lidar_map_xyz_m=np.concatenate([poles, ground]).astype(np.float32),
        lidar_map_cluster=np.full(len(poles) + len(ground), -1, np.int32),
        lidar_map_is_ground=np.r_[np.zeros(len(poles)), np.ones(len(ground))].astype(np.uint8),
    )  # fmt: skip


def day_of(seed, frames=12, **settings):
    rng = np.random.default_rng(seed)
    return [scene(rng, **settings) for _ in range(frames)]


def turned(T, pitch_rad):
    return from_rotation_translation(exp_so3(np.array([0.0, pitch_rad, 0.0])) @ T[:3, :3], T[:3, 3])

"""Pitch by static elevations, a part of them displaced towards the mirror image in the road: streets of known truth."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.objective.radar.heights import displaced_heights
from pipeline.rig.se3 import from_spherical, inverse, to_spherical, transform_points
from tests.makers.doppler_streets import GROUND_M, T_LIDAR_RADAR, turned
from tests.makers.radar_scenes import street_day


def with_road(rows):
    plane = np.array([0.0, 0.0, 1.0, -GROUND_M])
    return [
        replace(
            o,
            ground_plane=plane,
            lidar_map_is_ground=(o.lidar_map_xyz_m[:, 2] < GROUND_M + 0.01).astype(np.uint8),
        )
        for o in rows
    ]


def kerbs_and_cars(rng, share, T=T_LIDAR_RADAR, noise_deg=1.0, image=0.0, stray=0.0):
    """A frame of low things; so large a share of the detections lies between the thing and its image in the road.

    Others are the image itself, or anywhere.
    """
    [o] = with_road(street_day(1, int(rng.integers(1000)), dt_s=0.0))
    foot = np.stack([rng.uniform(8, 45, 60), rng.uniform(-12, 12, 60)], 1)
    top = rng.uniform(0.2, 2.2, 60)
    heights = np.arange(0.05, 2.2, 0.15)
    things = np.concatenate(
        [
            np.column_stack([np.tile(f, (len(heights), 1)), heights])[heights < t]
            for f, t in zip(foot, top, strict=True)
        ]
    )
    ground = np.column_stack([rng.uniform(3, 50, 1500), rng.uniform(-12, 12, 1500), np.zeros(1500)])
    seen = things[rng.integers(0, len(things), 150)]
    s = np.where(rng.random(150) < share, rng.random(150), 0.0)
    seen[:, 2] *= 1 - 2 * s
    kind = np.random.default_rng(0).permutation(150) / 150
    seen[:, 2] = np.where(kind < image, -seen[:, 2], seen[:, 2])
    seen[:, 2] = np.where(kind > 1 - stray, 14 * kind[::-1] - 6, seen[:, 2])
    for p in (things, ground, seen):
        p[:, 2] += GROUND_M
    noise = np.radians([0.2, noise_deg, 0.0]) * rng.standard_normal((150, 3))
    radar = from_spherical(to_spherical(transform_points(inverse(T), seen)) + noise)
    cloud = np.concatenate([things, ground]).astype(np.float32)
    return replace(
        o, radar_xyz_m=radar.astype(np.float32), radar_motion=np.zeros(150, np.uint8),
        radar_velocity_mps=np.zeros(3), radar_stamp_ns=o.stamp_ns, lidar_map_xyz_m=cloud,
        lidar_map_is_ground=np.r_[np.zeros(len(things)), np.ones(1500)].astype(np.uint8),
    )  # fmt: skip


def test_a_day_whose_detections_come_from_anywhere_tells_pitch_less_surely():
    rng = np.random.default_rng(7)
    right, strays = (
        displaced_heights([kerbs_and_cars(rng, 0.3, stray=s) for _ in range(15)], T_LIDAR_RADAR, 0.0, rng)
        for s in (0.0, 0.6)
    )
    assert right.explained > 0.9
    assert strays.floor_rad > 1.4 * right.floor_rad


def test_a_radar_that_points_down_is_turned_up_by_as_much():
    rng = np.random.default_rng(2)
    rows = [kerbs_and_cars(rng, 0.3) for _ in range(15)]
    right, down = (
        displaced_heights(rows, turned(T_LIDAR_RADAR, np.radians(d)), 0.0, np.random.default_rng(0))
        for d in (0.0, 1.0)
    )
    assert np.degrees(down.turn_rad - right.turn_rad) == pytest.approx(-1.0, abs=0.15)

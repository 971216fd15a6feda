"""Sweeps that no odometry de-skewed: by Doppler, as far as that knows, and counted."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pipeline.core.config import PerceiveConfig
from pipeline.core.rigs import TopicSemantics
from pipeline.perceive.camera import TopicSource
from pipeline.perceive.ego_velocity import RadarMotion
from pipeline.perceive.features import deskewed
from pipeline.perceive.stage import AS_LOGGED, BY_DOPPLER, Shown, Sources, perceive_moment
from pipeline.rig.se3 import exp_so3
from schemas.captures import Sweep
from tests.makers.lakes import joined_of

SPEED_MPS = 8.0  # of the made frames
NOISE_MPS = np.random.default_rng(0).uniform(-15, 15, 412).astype(np.float32)  # of no world


@settings(max_examples=25, deadline=None)
@given(st.floats(-10, 40), st.floats(-3, 3), st.integers(0, 100))
def test_a_world_seen_by_a_car_that_drives_straight_stands_still(speed, heading, seed):
    rng = np.random.default_rng(seed)
    world = rng.uniform(-50, 50, (40, 3))
    time = np.linspace(-0.1, 0.02, 40)
    seen = world - time[:, None] * [speed, 0.0, 0.0]  # the lidar looks ahead, the radar anywhere
    velocity_radar = exp_so3(np.array([0.0, 0.0, heading])) @ [speed, 0.0, 0.0]
    none = np.zeros(0, np.float32)
    motion = RadarMotion(velocity_radar, np.eye(3), none, none.astype(np.uint8), none.astype(np.int32))
    x, y, z, time_s = np.column_stack([seen, time]).astype(np.float32).T
    sweep = Sweep(
        moment=0, stamp_ns=0, lidar_x_m=x, lidar_y_m=y, lidar_z_m=z, lidar_intensity=None, lidar_ring=None,
        lidar_time_s=time_s, lidar_deskewed=False,
    )  # fmt: skip
    np.testing.assert_allclose(deskewed(sweep, motion, heading).lidar_xyz_m, world, atol=1e-4)


def skewed(made_frame, **changes):
    """A frame without odometry, as a lidar that turns within 100 ms would log it."""
    frame = made_frame(3)
    time_s = np.linspace(-0.1, 0.0, len(frame.lidar_x_m)).astype(np.float32)
    prior = {"priors": {"lidar_radar": np.eye(4)}}
    as_seen = {"lidar_x_m": (frame.lidar_x_m - SPEED_MPS * time_s).astype(np.float32), "lidar_time_s": time_s}
    return frame, replace(frame, lidar_deskewed=False, **(as_seen | prior | changes))


def perceived(frame, **options):
    source = TopicSource(TopicSemantics(source="topics", labels="/l", detections="/d"), PerceiveConfig())
    moment, captures = joined_of(frame)
    star = {tuple(pair.split("_")): T for pair, T in frame.priors.items()}
    shown = Shown(moment, captures, {kind: kind for kind in captures}, star)
    sources = Sources({"camera": source}, {"lidar": None}, {"radar": None}, PerceiveConfig(), **options)
    return perceive_moment(shown, sources, {})


def notes_of(found):
    """What is noted of sweeps: one image alone shows no motion of its camera."""
    return [note for note in found.notes if note != "camera_without_motion_no_earlier_image"]


def farthest(found, frame):
    """How far the sampled cloud lies from the points of a frame, at most."""
    cloud = found.features["lidar"].lidar_map_xyz_m
    return cKDTree(frame.lidar_xyz_m).query(cloud)[0].max()


def test_a_sweep_without_odometry_is_moved_by_the_radar_s_velocity(made_frame):
    right, frame = skewed(made_frame)
    found, left = perceived(frame), perceived(frame, deskew=False)
    assert (notes_of(found), notes_of(left)) == ([BY_DOPPLER], [])
    # 0.05 m/s of Doppler noise times a tenth of a second
    assert farthest(found, right) < 0.03
    assert farthest(left, frame) == 0.0
    assert farthest(left, right) > 0.2


@pytest.mark.parametrize(
    ("changes", "notes"),
    [
        ({"priors": {}}, [AS_LOGGED]),
        ({"radar_range_rate_mps": NOISE_MPS}, [AS_LOGGED]),
        ({"lidar_deskewed": True}, []),
        ({"lidar_time_s": None}, []),
    ],
    ids=["no prior", "no velocity", "moved by ingest", "no times"],
)
def test_a_sweep_that_cannot_be_moved_is_counted_and_one_that_need_not_is_not(made_frame, changes, notes):
    _, frame = skewed(made_frame)
    found = perceived(replace(frame, **changes))
    assert notes_of(found) == notes
    assert farthest(found, frame) == 0.0

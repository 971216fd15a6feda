"""Camera-lidar of method `joint` by itself on traced scenes: a prior off by so much, both halves, and the errors."""

import numpy as np

from pipeline.calibrate.joint.camera_lidar.estimate import align_camera_lidar, analyse_camera_lidar
from pipeline.core.config import SolveConfig
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import inverse, log_so3, perturb_exactly
from tests.makers.traced_scenes import T_TRUE


def prior_off_by(degrees, metres=0.05, seed=0):
    """The truth moved by exactly so much, with sigmas of 2 deg and 5 cm."""
    T = perturb_exactly(T_TRUE, np.radians(degrees), metres, np.random.default_rng(seed))
    return Prior(T, np.eye(4), float(np.radians(2.0)), 0.05)


def estimate_camera_lidar(observations, prior, config=None, rng=None):
    """T_camera_lidar and the camera's time offset, without another pair's heading."""
    rng = np.random.default_rng(0) if rng is None else rng
    return analyse_camera_lidar(align_camera_lidar(observations, prior, config or SolveConfig(), rng), rng)


def turn_and_sigma_deg(found):
    """Rotation error about the camera's axes, and its sigmas."""
    turn = log_so3((found.T @ inverse(T_TRUE))[:3, :3])
    return np.degrees(turn), np.degrees(np.sqrt(np.diag(found.covariance))[:3])

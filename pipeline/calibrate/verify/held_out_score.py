"""What held-out frames say of a pose, whatever method found it: costs to compare two poses, slopes to find their own.

The judge is the same for all methods: the sharp edges and road markings of method `joint` for camera-lidar,
its registration likelihood for lidar-radar (azimuth and range: its elevations are no judge, they collapse onto the
lidar's rings), azimuths of moving clusters against road users' boxes for camera-radar. The paper's losses can't judge:
their minimum lies off the truth. Maps are prepared once for all that is asked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_radar import camera_radar_cost
from pipeline.calibrate.numerics.response_surface import DESIGN, fit_quadratics
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import PairEstimate, Prior
from pipeline.geometry.changes import change_jacobian
from pipeline.geometry.se3 import exp_se3, exp_so3, from_rotation_translation, log_so3, rotation_angle_rad
from pipeline.objective.camera_lidar.score import (
    Alignments,
    KernelSettings,
    Terms,
    lidar_velocities,
    prepare_terms,
)
from pipeline.objective.radar.moving_clusters import azimuth_equations_camera, moving_clusters
from pipeline.objective.radar.registration import RegistrationFrames, normal_equations, registration_frames
from schemas.observations import Observation

__all__ = ["Alignment", "alignment_of"]

_FOCAL_SIGMA, _RANGE_BIAS_SIGMA_M = 0.003, 0.05
_MAX_GAP_PX = 5.0  # edges whose interval is wider (16 rings: 30 px) are for the basin only
_SHARP_PX, _SHARP_CONTRAST = 1.5, 2
_WIDE_CONTRAST = 1  # for kernels twice as wide and more
_REACH_RAD = np.radians(1.0)
_TYPICAL_RANGE_M, _TYPICAL_SPEED_MPS = 12.0, 8.0
# Azimuth, elevation, range: wide in elevation, which is not what decides.
_REGISTRATION_SIGMA = np.array([np.radians(0.5), np.radians(6.0), 0.2])
_PLANAR = np.array([0.0, 0, 1, 1, 1, 0, 1, 1])  # yaw, x, y, time offset, range bias
_OUTLIER = 0.2  # in lidar points at distance 0
_BOX_GATE_RAD = np.radians(2.0)
_IDLE = np.array([1.0, 1.0])  # sigma of a nuisance that a pair does not have
# What no number of held-out frames lowers: mask dilation and the like; where in an object radars see it.
_BIAS = {
    "camera_lidar": np.array([*np.radians([0.03] * 3), 0.01, 0.01, 0.01, 0.004, 0.0]),
    "lidar_radar": np.array([*np.radians([0.1, 0.15, 0.05]), 0.02, 0.02, 0.02, 0.002, 0.0]),
    "camera_radar": np.array([*np.radians([0.3, 0.1, 0.3]), 0.1, 0.1, 0.1, 0.0, 0.0]),
}


@dataclass(frozen=True, eq=False)
class Alignment:
    """Questions that the held-out frames of one pair answer."""

    # T of the pair -> cost per frame, NaN where a frame cannot tell; lower is better. Time offset and nuisance are the
    # result's at every pose, and so are unknowns of the pose that the judge cannot tell: the others are compared.
    cost: Callable[[np.ndarray], np.ndarray]
    # (step from the result: left perturbation, time offset, nuisance; kernel width, 1 = sharp) -> each frame's
    # gradient of its log likelihood and information.
    slopes: Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray]]
    extra_variance: Float[np.ndarray, " 2"]  # of the result's time offset and of the nuisance
    bias: Float[np.ndarray, " 8"]  # sigma of errors common to all frames


def alignment_of(
    estimate: PairEstimate, observations: Sequence[Observation], prior: Prior, config: SolveConfig
) -> Alignment:
    """Prepare frames that took no part in the fit.

    Args:
        estimate: the result that they judge.
        observations: the held-out frames, of one camera.
        prior: the other pose of interest; turns the radar's own velocity into lidar axes.
        config: sigma of a time offset that a method did not estimate.
    """
    judge = {"camera_lidar": _camera_lidar, "lidar_radar": _lidar_radar, "camera_radar": _camera_radar}
    cost, slopes, nuisance_sigma = judge[estimate.pair](estimate, observations, prior)
    dt_sigma_s = (
        config.time_offset_sigma_s if estimate.time_offset_sigma_s is None else estimate.time_offset_sigma_s
    )
    extra = np.array([max(dt_sigma_s, 1e-4), nuisance_sigma]) ** 2
    return Alignment(cost, slopes, extra, _BIAS[estimate.pair])


Judge = tuple[
    Callable[[np.ndarray], np.ndarray],
    Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray]],
    float,
]


def _camera_lidar(estimate: PairEstimate, observations: Sequence[Observation], prior: Prior) -> Judge:
    apart = rotation_angle_rad(estimate.T @ np.linalg.inv(prior.T_camera_lidar))
    velocity = lidar_velocities(observations, prior.T_lidar_radar)
    reach = float(apart) + _REACH_RAD
    terms = prepare_terms(observations, estimate.T, velocity, reach_rad=reach).sharp(_MAX_GAP_PX)
    focal, dt_s = estimate.diagnostics.get("focal_scale", 1.0), estimate.time_offset_s or 0.0
    told = np.array([len(o.lidar_edge_xyz_m) + len(o.marking_xyz_m) > 0 for o in observations])
    sharp = KernelSettings.wide(_SHARP_PX, _SHARP_CONTRAST)

    def cost(T: np.ndarray) -> np.ndarray:
        at = Alignments(T[None], np.array([dt_s]), np.array([focal]))
        score = (terms.edge_excess(at, sharp) + terms.marking_score(at, sharp))[0]
        return np.where(told, -score, np.nan)

    def slopes(step: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
        scale = _camera_lidar_scale(terms, width)
        x = step + DESIGN * scale
        at = Alignments(exp_se3(x[:, :6]) @ estimate.T, dt_s + x[:, 6], focal + x[:, 7])
        contrast = _SHARP_CONTRAST if width < 2 else _WIDE_CONTRAST
        gradient, H = fit_quadratics(terms.score(at, KernelSettings.wide(width * _SHARP_PX, contrast)))
        return gradient / scale, -H / np.outer(scale, scale)

    return cost, slopes, _FOCAL_SIGMA


def _camera_lidar_scale(terms: Terms, width: float) -> Float[np.ndarray, " 8"]:
    """Step per unknown that moves typical points by about two kernel widths: the score is rough below one."""
    angle = 1.8 * width * _SHARP_PX / float(terms.camera[1])
    shift = angle * _TYPICAL_RANGE_M
    return np.array([angle] * 3 + [shift] * 3 + [shift / _TYPICAL_SPEED_MPS, 1.8 * _FOCAL_SIGMA])


def _lidar_radar(estimate: PairEstimate, observations: Sequence[Observation], prior: Prior) -> Judge:
    del prior
    # The detections are picked alike at every pose.
    frames = registration_frames(observations, estimate.T, np.random.default_rng(0))
    range_bias_m, dt_s = estimate.diagnostics.get("range_bias_m", 0.0), estimate.time_offset_s or 0.0

    def cost(T: np.ndarray) -> np.ndarray:
        out = np.full(len(observations), np.nan)
        if frames.count:
            planar = _with_planar(estimate.T, T)
            found = normal_equations(
                frames, planar, dt_s, _REGISTRATION_SIGMA, 0.0, _OUTLIER, range_bias_m=range_bias_m
            )
            out[frames.frame] = found.cost
        return out

    def slopes(step: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
        g, H = np.zeros((len(observations), 8)), np.zeros((len(observations), 8, 8))
        if frames.count:
            g[frames.frame], H[frames.frame] = _registration_slopes(
                frames, estimate, range_bias_m, step, width
            )
        return g, H

    return cost, slopes, _RANGE_BIAS_SIGMA_M


def _with_planar(T: np.ndarray, T_planar: np.ndarray) -> np.ndarray:
    """A pose of the radar with another one's yaw, x and y."""
    turn = log_so3(T_planar[:3, :3] @ T[:3, :3].T)
    R = exp_so3(np.array([0.0, 0.0, turn[2]])) @ T[:3, :3]
    return from_rotation_translation(R, np.append(T_planar[:2, 3], T[2, 3]))


def _registration_slopes(
    frames: RegistrationFrames, estimate: PairEstimate, range_bias_m: float, step: np.ndarray, width: float
) -> tuple[np.ndarray, np.ndarray]:
    T = exp_se3(step[:6]) @ estimate.T
    found = normal_equations(
        frames,
        T,
        (estimate.time_offset_s or 0.0) + float(step[6]),
        _REGISTRATION_SIGMA * np.array([width, 1.0, width]),
        0.0,
        _OUTLIER,
        range_bias_m=range_bias_m + float(step[7]),
    )
    # In turns about the radar and shifts: roll, pitch and z move azimuths too, but are not these equations' to tell.
    C = np.eye(8)
    C[:6, :6] = change_jacobian(T)
    only = np.linalg.inv(C) @ np.diag(_PLANAR) @ C
    return -found.g[0] @ only, only.T @ found.information[0] @ only


def _camera_radar(estimate: PairEstimate, observations: Sequence[Observation], prior: Prior) -> Judge:
    del prior
    clusters = moving_clusters(observations)

    def cost(T: np.ndarray) -> np.ndarray:
        return camera_radar_cost(observations, T)

    def slopes(step: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
        g, H = np.zeros((len(observations), 8)), np.zeros((len(observations), 8, 8))
        T = exp_se3(step[:6]) @ estimate.T
        H[:, :6, :6], g[:, :6], _ = azimuth_equations_camera(clusters, T, width * _BOX_GATE_RAD)
        return -g, H

    return cost, slopes, float(_IDLE[1])

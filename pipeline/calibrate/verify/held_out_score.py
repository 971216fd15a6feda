"""Alignment of held-out frames at a pose of any method: costs to compare two poses, and derivatives.

All methods are judged by the same scores: sharp edges and road markings for camera-lidar, the registration
likelihood of method `joint` for lidar-radar (azimuth and range only: its elevations are misled by the lidar's
rings), azimuths of moving clusters against road users' boxes for camera-radar. The paper's losses are not
used, because their minimum is not at the truth. Maps are prepared once for all poses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.numerics.covariance import DESIGN, fit_quadratics
from pipeline.calibrate.numerics.nuisances import (
    FOCAL_SIGMA,
    HELD_OUT_BIAS,
    OUTLIER_DENSITY,
    RANGE_BIAS_SIGMA_M,
    REGISTRATION_COMPARISON_SIGMA,
    TYPICAL_RANGE_M,
    TYPICAL_SPEED_MPS,
)
from pipeline.calibrate.verify.held_out import FrameDerivatives
from pipeline.core.config import SolveConfig
from pipeline.objective.camera_lidar.label_width import widened
from pipeline.objective.camera_lidar.points import lidar_velocities
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Start, Terms, prepare_terms
from pipeline.objective.radar.moving_clusters import (
    azimuth_equations_camera,
    camera_radar_cost,
    moving_clusters,
)
from pipeline.objective.radar.registration import (
    RegistrationFrames,
    normal_equations,
    registration_cost,
    registration_frames,
)
from pipeline.objective.stamp_gaps import constant_gap_s, expected_dt_s, gaps_s
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.se3 import (
    change_jacobian,
    exp_se3,
    exp_so3,
    from_rotation_translation,
    log_so3,
    rotation_angle_rad,
)
from schemas.observations import Observation

__all__ = ["HeldOutScore", "held_out_score"]

_SHARP_PX, _SHARP_CONTRAST = 1.5, 2  # kernel width and contrast level that costs are compared at
_WIDE_CONTRAST = 1  # for kernels twice as wide and more
_SURFACE_SIZE = 1.8  # radius of the response surface in kernel widths: the score is rough below one
_REACH_RAD = np.radians(1.0)  # beyond result and prior, for points near the image's border
_PLANAR = np.array([0.0, 0, 1, 1, 1, 0, 1, 1])  # yaw, x, y, time offset, range bias
_BOX_GATE_RAD = np.radians(2.0)
_NO_NUISANCE_SIGMA = 1.0  # any: nothing depends on it
_LEAST_DT_SIGMA_S = 1e-4
_TREND_M = (0.8, 1.2)  # four and six sigmas of the range at which costs are compared

# T of the pair -> cost of each frame.
_FrameCosts = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class HeldOutScore:
    """The score of the held-out frames of one pair, as functions of the pose."""

    # T of the pair -> cost per frame, NaN where a frame shows nothing; lower is better. Time offset and nuisance are
    # the result's at every pose, and so are degrees of freedom that the score does not depend on.
    cost: _FrameCosts
    derivatives: FrameDerivatives
    extra_variance: Float[np.ndarray, " 2"]  # of the result's time offset [s2] and of the nuisance
    bias: Float[np.ndarray, " 8"]  # sigma of errors common to all frames


def held_out_score(
    estimate: PairEstimate, observations: Sequence[Observation], prior: Prior, config: SolveConfig
) -> HeldOutScore:
    """Prepare frames that took no part in the fit.

    Args:
        estimate: the result to be judged.
        prior: the pose to compare with; it also rotates the radar's own velocity into lidar axes.
        config: sigma of a time offset that a method did not estimate.
    """
    prepare = {"camera_lidar": _camera_lidar, "lidar_radar": _lidar_radar, "camera_radar": _camera_radar}
    cost, derivatives, nuisance_sigma = prepare[estimate.pair](estimate, observations, prior)
    dt_sigma_s = (
        config.time_offset_sigma_s if estimate.time_offset_sigma_s is None else estimate.time_offset_sigma_s
    )
    extra = np.array([max(dt_sigma_s, _LEAST_DT_SIGMA_S), nuisance_sigma]) ** 2
    return HeldOutScore(cost, derivatives, extra, HELD_OUT_BIAS[estimate.pair])


def _camera_lidar(
    estimate: PairEstimate, observations: Sequence[Observation], prior: Prior
) -> tuple[_FrameCosts, FrameDerivatives, float]:
    apart = rotation_angle_rad(estimate.T @ np.linalg.inv(prior.T_camera_lidar))
    heading_rad = None if prior.heading is None else prior.heading[0]
    velocity = lidar_velocities(observations, prior.T_lidar_radar, heading_rad)
    reach = float(apart) + _REACH_RAD
    readout_s = prior.camera.readout_s
    # As in the fit: paint is looked for where the prior puts free ground.
    start = Start(prior.T_camera_lidar, prior.rotation_sigma_rad)
    terms = prepare_terms(
        observations, estimate.T, velocity, reach_rad=reach, readout_s=readout_s, start=start
    )
    focal = estimate.diagnostics.get("focal_scale", 1.0)
    dt_s = estimate.time_offset_s
    if dt_s is None:  # of methods that estimate none
        dt_s = expected_dt_s(gaps_s(observations, "camera"), prior.camera.stamp_sigma_s)
    # The same points at every pose that is compared: rows that a prior a few degrees off would change by a tenth.
    terms = terms.telling().exposed_at(Alignments(estimate.T[None], np.array([dt_s]), np.array([focal])))
    terms = widened(terms, estimate.T, estimate.diagnostics.get("label_width_px", 0.0))
    has_points = np.array([len(o.lidar_edge_xyz_m) + len(o.marking_xyz_m) > 0 for o in observations])
    sharp = KernelSettings.wide(_SHARP_PX, _SHARP_CONTRAST)

    def cost(T: np.ndarray) -> np.ndarray:
        at = Alignments(T[None], np.array([dt_s]), np.array([focal]))
        edges, paint = (terms.beyond_chance(s, at, sharp) for s in (Terms.edge_score, Terms.marking_score))
        score = (edges + paint)[0]
        return np.where(has_points, -score, np.nan)

    def derivatives(step: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
        scale = _camera_lidar_scale(terms, width)
        x = step + DESIGN * scale
        at = Alignments(exp_se3(x[:, :6]) @ estimate.T, dt_s + x[:, 6], focal + x[:, 7])
        contrast = _SHARP_CONTRAST if width < 2 else _WIDE_CONTRAST
        gradient, H = fit_quadratics(terms.score(at, KernelSettings.wide(width * _SHARP_PX, contrast)))
        return gradient / scale, -H / np.outer(scale, scale)

    return cost, derivatives, FOCAL_SIGMA


def _camera_lidar_scale(terms: Terms, width: float) -> Float[np.ndarray, " 8"]:
    """Radius of the response surface per unknown: moves typical points by about two kernel widths."""
    angle = _SURFACE_SIZE * width * _SHARP_PX / float(terms.camera[1])
    shift = angle * TYPICAL_RANGE_M
    return np.array([angle] * 3 + [shift] * 3 + [shift / TYPICAL_SPEED_MPS, _SURFACE_SIZE * FOCAL_SIGMA])


def _lidar_radar(
    estimate: PairEstimate, observations: Sequence[Observation], prior: Prior
) -> tuple[_FrameCosts, FrameDerivatives, float]:
    del prior
    # A generator of its own: the same detections are picked at every pose.
    frames = registration_frames(observations, estimate.T, np.random.default_rng(0))
    range_bias_m = estimate.diagnostics.get("range_bias_m", 0.0)
    dt_s = (
        -constant_gap_s(gaps_s(observations, "radar"))
        if estimate.time_offset_s is None
        else estimate.time_offset_s
    )

    def value(T: np.ndarray) -> np.ndarray:
        sigma = REGISTRATION_COMPARISON_SIGMA
        return registration_cost(frames, T, dt_s, sigma, OUTLIER_DENSITY, range_bias_m=range_bias_m)

    trend_per_m = _trend_along_axis(estimate.T, value)

    def cost(T: np.ndarray) -> np.ndarray:
        out = np.full(len(observations), np.nan)
        if frames.count:
            nearer_m = float((T[:3, 3] - estimate.T[:3, 3]) @ estimate.T[:3, 0])
            out[frames.frame] = value(_with_planar(estimate.T, T)) - nearer_m * trend_per_m
        return out

    def derivatives(step: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
        g, H = np.zeros((len(observations), 8)), np.zeros((len(observations), 8, 8))
        if frames.count:
            g[frames.frame], H[frames.frame] = _registration_derivatives(
                frames, estimate.T, dt_s, range_bias_m, step, width
            )
        return g, H

    return cost, derivatives, RANGE_BIAS_SIGMA_M


def _trend_along_axis(T: np.ndarray, value: _FrameCosts) -> Float[np.ndarray, " F"]:
    """Slope [1/m] of each frame's cost along the radar's axis, at shifts too large for detections to match.

    The cost decreases towards regions with more lidar points, which are near the car, for any radar data. By
    the cost alone, a pose some centimetres too near is better than the right one on streets that are dense
    nearby.
    """
    ahead, behind = (
        [value(from_rotation_translation(T[:3, :3], T[:3, 3] + sign * m * T[:3, 0])) for m in _TREND_M]
        for sign in (1, -1)
    )
    slopes = [(a - b) / (2 * m) for m, a, b in zip(_TREND_M, ahead, behind, strict=True)]
    return np.asarray(np.mean(slopes, axis=0))


def _with_planar(T: np.ndarray, T_planar: np.ndarray) -> np.ndarray:
    """A pose of the radar with the yaw, x and y of another one."""
    turn = log_so3(T_planar[:3, :3] @ T[:3, :3].T)
    R = exp_so3(np.array([0.0, 0.0, turn[2]])) @ T[:3, :3]
    return from_rotation_translation(R, np.append(T_planar[:2, 3], T[2, 3]))


def _registration_derivatives(
    frames: RegistrationFrames, T_lidar_radar: np.ndarray, dt_s: float, range_bias_m: float, step: np.ndarray,
    width: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Gradient (F 8) and information (F 8 8) of the registration by yaw, x, y, time offset and range bias only."""
    T = exp_se3(step[:6]) @ T_lidar_radar
    found = normal_equations(
        frames, T, dt_s + float(step[6]), REGISTRATION_COMPARISON_SIGMA * np.array([width, 1.0, width]), 0.0,
        OUTLIER_DENSITY, range_bias_m=range_bias_m + float(step[7]),
    )  # fmt: skip
    # In turns about the radar and shifts: roll, pitch and z move azimuths too, but azimuths do not determine them.
    C = np.eye(8)
    C[:6, :6] = change_jacobian(T)
    only = np.linalg.inv(C) @ np.diag(_PLANAR) @ C
    return -found.g[0] @ only, only.T @ found.information[0] @ only


def _camera_radar(
    estimate: PairEstimate, observations: Sequence[Observation], prior: Prior
) -> tuple[_FrameCosts, FrameDerivatives, float]:
    del prior
    clusters = moving_clusters(observations)

    def cost(T: np.ndarray) -> np.ndarray:
        return camera_radar_cost(observations, T)

    def derivatives(step: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
        g, H = np.zeros((len(observations), 8)), np.zeros((len(observations), 8, 8))
        T = exp_se3(step[:6]) @ estimate.T
        H[:, :6, :6], g[:, :6], _ = azimuth_equations_camera(clusters, T, width * _BOX_GATE_RAD)
        return -g, H

    return cost, derivatives, _NO_NUISANCE_SIGMA

"""Camera-radar without the lidar: moving clusters against boxes in azimuth, detections in boxes in elevation.

Its translation stays at the prior (angles of far objects say nothing of it). Method `joint` composes camera-radar
from the other two; this estimate is what that composition is checked against.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.lidar_radar.normal_equations import tempered
from pipeline.calibrate.numerics.covariance import covariance_with_fixed, posterior
from pipeline.calibrate.numerics.frame_blocks import bootstrap_blocks
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import PairEstimate, Prior
from pipeline.geometry.cameras import camera_of
from pipeline.geometry.changes import change_jacobian
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, log_so3, transform_points
from pipeline.objective.radar.moving_clusters import (
    MovingClusters,
    azimuth_equations_camera,
    camera_azimuth_residuals,
    moving_clusters,
)
from pipeline.objective.radar.vehicle_boxes import (
    BIAS_SIGMA_RAD,
    BOX_CLASSES,
    VehicleBoxes,
    box_equations,
    box_pairs,
    vehicle_boxes,
)
from schemas.observations import Observation

__all__ = ["camera_radar_cost", "estimate_camera_radar"]

_SCAN_STEP_RAD = np.radians(0.5)
_GATES_RAD = np.radians([4.0, 3.0, 2.5, 2.0, 2.0, 2.0, 2.0, 2.0])
_ELEVATION_GATE_RAD = np.radians([12.0, 7.0])
_MATCH_RAD = np.radians(1.0)  # half a car at 40 m
# Boxes of cars seen from behind and aside are not centred on where radars see them; constants of elevation.
_BIAS_FLOOR = np.array([np.radians(0.3), np.radians(0.25), np.radians(0.1), 0.0, 0.0, 0.0])
# Roll by boxes was 1.0 deg RMS off on nine simulated days whose boxes promised .5.
_BOX_FLOOR = np.radians(np.array([0.0, 0.0, 1.2, 0.0, 0.0, 0.0, *[0.0] * len(BOX_CLASSES)]))
_HELD = np.arange(6 + len(BOX_CLASSES)) // 3 == 1  # the position: angles of far objects say little of it
_CONTRADICTED = 2.5  # prior sigmas from which data that say otherwise are believed


def estimate_camera_radar(
    observations: Sequence[Observation], prior: Prior, config: SolveConfig, rng: np.random.Generator
) -> PairEstimate:
    """Estimate the rotation of T_camera_radar from what camera and radar both see; never uses the lidar.

    Args:
        observations: frames.
        prior: start and prior; translation stays there.
        config: search range, resampling.
        rng: resamples.
    """
    clusters, boxes_seen = moving_clusters(observations), vehicle_boxes(observations)
    T0 = prior.T_camera_radar
    prior_covariance = prior.covariance("camera_radar")
    before = np.append(np.diag(prior_covariance), np.full(len(BOX_CLASSES), BIAS_SIGMA_RAD**2))
    T, bias = _scan_azimuth(clusters, T0, config), np.zeros(len(BOX_CLASSES))
    for k, gate in enumerate(_GATES_RAD):
        H, g, box_sigma, azimuth_sigma, boxes = _equations(
            clusters, boxes_seen, observations, T, bias, gate, k
        )
        x = np.concatenate([log_so3(T[:3, :3] @ T0[:3, :3].T), np.zeros(3), bias])
        # A prior that the data contradict by many sigmas loses weight (Cauchy); an axis that they don't see keeps it.
        pull = np.diag(1 / before / (1 + x**2 / before / _CONTRADICTED**2))
        step = np.zeros(len(x))
        at = np.ix_(~_HELD, ~_HELD)
        step[~_HELD] = -np.linalg.solve((H.sum(0) + pull)[at], (g.sum(0) + pull @ x)[~_HELD])
        step *= min(1.0, 0.05 / max(float(np.abs(step).max()), 1e-9))
        T = from_rotation_translation(exp_so3(step[:3]) @ T[:3, :3], T0[:3, 3])
        bias = bias + step[6:]
    block = bootstrap_blocks(np.array([o.drive for o in observations]), config.bootstrap_blocks)
    covariance = covariance_with_fixed(H, g, before, H.sum(0) + np.diag(1 / before), _HELD, block, rng)[
        :6, :6
    ]
    # Left perturbations about the camera carry the radar along; these were turns about the radar.
    J = np.linalg.inv(change_jacobian(T))
    after = posterior(covariance, prior_covariance, _BIAS_FLOOR)
    seen = len(np.unique(clusters.frame))
    diagnostics = {
        "box_sigma_rad": box_sigma,
        "azimuth_sigma_rad": azimuth_sigma,
        "boxes": float(boxes),
        "moving_clusters": float(clusters.count),
    }
    return PairEstimate(
        "camera_radar",
        T,
        J @ after.covariance @ J.T,
        after.observability,
        after.observable,
        seen,
        {"no moving cluster": len(observations) - seen},
        diagnostics={k: v for k, v in diagnostics.items() if np.isfinite(v)},
        notes=["translation stays at the prior"],
    )


def camera_radar_cost(
    observations: Sequence[Observation], T_camera_radar: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " F"]:
    """Cost of each frame at a pose for held-out verdicts: robust azimuth distance of moving clusters to boxes, 0..1.

    Clusters in the camera's view count, those without any box within 3 deg as 1. NaN where a frame has none or no
    boxes.
    """
    clusters = moving_clusters(observations)
    out = np.full(len(observations), np.nan)
    if not clusters.count:
        return out
    visible = _in_view(clusters, observations, T_camera_radar)
    residual, _, frame = camera_azimuth_residuals(clusters, T_camera_radar, 3 * _MATCH_RAD)
    gain = np.bincount(frame, 1 / (1 + (residual / _MATCH_RAD) ** 2), minlength=len(observations))
    total = np.bincount(clusters.frame[visible], minlength=len(observations))
    told = (total > 0) & np.array([len(o.road_user_classes) > 0 for o in observations])
    out[told] = 1 - np.minimum(gain[told] / total[told], 1.0)
    return out


def _scan_azimuth(clusters: MovingClusters, T0: np.ndarray, config: SolveConfig) -> np.ndarray:
    """The turn about the camera's vertical under which most moving clusters meet a box, near turns first."""
    reach = np.radians(1.2 * config.search_rotation_deg)
    turns = np.arange(-np.ceil(reach / _SCAN_STEP_RAD), np.ceil(reach / _SCAN_STEP_RAD) + 1) * _SCAN_STEP_RAD
    poses = [
        from_rotation_translation(exp_so3(np.array([0.0, a, 0.0])) @ T0[:3, :3], T0[:3, 3]) for a in turns
    ]
    scores = []
    for T, turn in zip(poses, turns, strict=True):
        residual, _, _ = camera_azimuth_residuals(clusters, T, 3 * _MATCH_RAD)
        # The search box as a weak prior: chance matches must not carry an estimate away where nothing moves.
        scores.append(float(np.sum(1 / (1 + (residual / _MATCH_RAD) ** 2))) - 2.0 * (turn / reach) ** 2)
    return poses[int(np.argmax(scores))]


def _equations(
    clusters: MovingClusters,
    boxes: VehicleBoxes,
    observations: Sequence[Observation],
    T: np.ndarray,
    bias: np.ndarray,
    gate: float,
    step: int,
) -> tuple[np.ndarray, np.ndarray, float, float, int]:
    F = len(observations)
    pairs = box_pairs(observations, boxes, T, float(_ELEVATION_GATE_RAD[min(step // 4, 1)]))
    # With the radar's own frame in the lidar's place, the left twist is that of T_camera_radar.
    Hb, gb, box_sigma = box_equations(pairs, np.eye(4), T, bias, F)
    Ha, ga, azimuth_sigma = azimuth_equations_camera(clusters, T, float(gate))
    about_radar = np.eye(Hb.shape[1])
    about_radar[:6, :6] = np.linalg.inv(change_jacobian(T))
    # Azimuths say yaw: of roll and pitch they know only by the heights of clusters, which are guesses, as azimuths of
    # boxes were chosen by the pose. Elevations in boxes say pitch and roll, and roll no better than the picked
    # detections of a box.
    only_yaw, only_elevation = about_radar.copy(), about_radar.copy()
    only_yaw[:, [0, 2]], only_elevation[:, 1] = 0.0, 0.0
    Hb, gb = tempered(only_elevation.T @ Hb @ only_elevation, gb @ only_elevation, _BOX_FLOOR)
    A = only_yaw[:6, :6]
    Hb[:, :6, :6] += A.T @ Ha @ A
    gb[:, :6] += ga @ A
    return Hb, gb, box_sigma, azimuth_sigma, pairs.count


def _in_view(
    clusters: MovingClusters, observations: Sequence[Observation], T_camera_radar: np.ndarray
) -> np.ndarray:
    """Clusters whose azimuth the camera covers."""
    points = transform_points(T_camera_radar, clusters.point_radar_m)
    out = np.zeros(clusters.count, bool)
    for f in np.unique(clusters.frame):
        o = observations[f]
        camera = camera_of(o)
        index = np.flatnonzero(clusters.frame == f)
        uv, valid = camera.project(points[index])
        out[index] = valid & (uv[:, 0] > 0) & (uv[:, 0] < o.image_width_px - 1)
    return out

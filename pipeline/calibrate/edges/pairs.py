"""Edges camera-lidar, lidar-radar, camera-radar: what their data show without the prior, by `joint`'s estimators.

Each is solved from the two sensors of its edge alone. Whatever ties it to a third sensor is given as a value: the car's
heading in the lidar's axes, a camera whose vehicle boxes say a radar's roll. Boxes count once: they belong to
camera_radar, unless a lidar_radar is given the camera, and then camera_radar goes without.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.adjust.evidence import evidence_of
from pipeline.calibrate.joint.camera_lidar.estimate import Aligned, align_camera_lidar, analyse_camera_lidar
from pipeline.calibrate.joint.camera_lidar.intrinsics import contradictions
from pipeline.calibrate.joint.camera_radar import estimate_camera_radar
from pipeline.calibrate.joint.failed_checks import lidar_radar_failures, unvouched_basin
from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.config import SolveConfig
from pipeline.extrinsics.checks import FailedCheck
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.changes import change_covariance
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import Edge
from pipeline.rigs import CameraPrior
from schemas.observations import Observation

__all__ = [
    "PAIR_ESTIMATORS",
    "camera_lidar_evidence",
    "camera_radar_evidence",
    "lidar_radar_evidence",
    "pair_prior",
]


def camera_lidar_evidence(
    observations: Sequence[Observation],
    edge: Edge,
    prior: Prior,
    config: SolveConfig,
    rng: np.random.Generator,
    *,
    heading: tuple[Float[np.ndarray, "4 4"], float] | None = None,
) -> EdgeEvidence:
    """Evidence of a camera and a lidar.

    Args:
        observations: frames of these two sensors.
        edge: camera and lidar.
        prior: as of `pair_prior`.
        config: effort.
        rng: decides everything random.
        heading: T_lidar_radar of a radar whose Doppler shows the car's way, and its sigma of yaw [rad]; without it the
            car drives along the lidar's x axis, or as the prior's radar has it.

    Raises:
        SolveError: too few frames, or nothing to align in them.
    """
    aligned = align_camera_lidar(observations, prior, config, rng)
    found = analyse_camera_lidar(aligned, rng, heading=heading)
    return evidence_of(found, edge, prior, config.time_offset_sigma_s, _camera_failures(aligned, prior))


def lidar_radar_evidence(
    observations: Sequence[Observation],
    edge: Edge,
    prior: Prior,
    config: SolveConfig,
    rng: np.random.Generator,
    *,
    camera: tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]] | None = None,
) -> EdgeEvidence:
    """Evidence of a lidar and a radar; arguments as of `camera_lidar_evidence`.

    `camera` is T_camera_lidar and its covariance, of a camera whose vehicle boxes take part.

    Raises:
        SolveError: too few frames with static detections and a lidar map.
    """
    T, covariance = camera if camera is not None else (None, None)
    found = estimate_lidar_radar(observations, prior, T, config, rng, covariance_camera_lidar=covariance)
    return evidence_of(found, edge, prior, config.time_offset_sigma_s, lidar_radar_failures(found))


def camera_radar_evidence(
    observations: Sequence[Observation],
    edge: Edge,
    prior: Prior,
    config: SolveConfig,
    rng: np.random.Generator,
    *,
    boxes: bool = True,
) -> EdgeEvidence:
    """Evidence of a camera and a radar; arguments as of `camera_lidar_evidence`.

    `boxes`: False where a lidar_radar has the elevations in this camera's vehicle boxes.
    """
    found = estimate_camera_radar(observations, prior, config, rng, boxes=boxes)
    return evidence_of(found, edge, prior, config.time_offset_sigma_s)


# By the edge's kind: (observations, edge, prior, config, rng) -> EdgeEvidence.
PAIR_ESTIMATORS: Final[dict[str, Callable[..., EdgeEvidence]]] = {
    "camera_lidar": camera_lidar_evidence,
    "lidar_radar": lidar_radar_evidence,
    "camera_radar": camera_radar_evidence,
}


def pair_prior(poses: Extrinsics, edge: Edge, camera: CameraPrior | None = None) -> Prior:
    """What the pairwise estimators take for a prior: the pose between two sensors, its sigmas alike on all axes.

    Args:
        poses: prior of the rig.
        edge: of two sensors that the pairwise estimators know.
        camera: what is known of the edge's camera.
    """
    T = poses.between(edge.parent.name, edge.child.name)
    covariance = change_covariance(T, poses.covariance_between(edge.parent.name, edge.child.name))
    turn, shift = (float(np.sqrt(np.diag(covariance)[part].mean())) for part in (slice(0, 3), slice(3, 6)))
    unknown = np.full((4, 4), np.nan)
    camera = camera or CameraPrior()
    if edge.kind == "camera_radar":
        return Prior(unknown, unknown, turn, shift, camera=camera, T_camera_radar_alone=T)
    of_camera = edge.kind == "camera_lidar"
    return Prior(T if of_camera else unknown, unknown if of_camera else T, turn, shift, camera=camera)


def _camera_failures(aligned: Aligned, prior: Prior) -> list[FailedCheck]:
    """A basin that nothing else leads to, else a CameraInfo that the day contradicts."""
    lost = unvouched_basin(aligned.basin)
    return [FailedCheck(lost, disproves=True)] if lost else contradictions(aligned.intrinsics, prior.camera)

"""Brute force over rotations: the camera-lidar score at a moderately sharp kernel on a grid about a pose.

Sharp scores have many maxima, coarse ones lie; a kernel of half a degree has the truth well above all else, and over
rotations alone a grid that fine is affordable: some thousands of poses at a few nanoseconds per point. Shifts within
the prior's sigma turn most points by less than the kernel.

Source: OpenCalib's CalibAnything (Luo et al. 2023) searches rotations by brute force too, and loses no start of 5 deg.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_lidar.schedule import SCHEDULE
from pipeline.geometry.se3 import exp_so3, from_rotation_translation
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms

__all__ = ["grid_maxima"]

_BATCH = 512  # poses at a time: their rows of 3x4 transforms by frame stay in the cache


def grid_maxima(
    terms: Terms, T_camera_lidar: Float[np.ndarray, "4 4"], reach_rad: float, rng: np.random.Generator
) -> list[Float[np.ndarray, "4 4"]]:
    """The best poses of a grid of turns about the camera's axes, best first, each the best of its surroundings.

    Args:
        terms: points of the frames to look at.
        T_camera_lidar: centre of the grid; its translation is kept.
        reach_rad: half-width of the grid per axis.
        rng: thins the points.
    """
    points = len(terms.edges.xyz_m) + len(terms.markings.xyz_m)
    thin = terms.thinned(min(1.0, SCHEDULE.grid_points / max(points, 1)), rng)
    is_wide = reach_rad > np.radians(SCHEDULE.wide_box_deg)
    kernel_rad = np.radians(SCHEDULE.wide_grid_kernel_deg if is_wide else SCHEDULE.grid_kernel_deg)
    kernel = KernelSettings.wide(kernel_rad * float(terms.camera[1]), 0, match=SCHEDULE.coarse_match)
    turns = _turns(reach_rad, kernel_rad)
    rotations = exp_so3(turns) @ T_camera_lidar[:3, :3]
    poses = from_rotation_translation(rotations, np.broadcast_to(T_camera_lidar[:3, 3], (len(turns), 3)))
    excess = _excess(thin, poses, kernel)
    return [poses[i] for i in _separate(turns, excess, SCHEDULE.grid_apart_kernels * kernel_rad)]


def _turns(reach_rad: float, kernel_rad: float) -> Float[np.ndarray, "P 3"]:
    """Rotation vectors on a grid; roll moves points half as much as the others, so its step is twice as wide."""
    step = SCHEDULE.grid_step_kernels * kernel_rad
    steps = np.array([step, step, 2 * step])
    count = np.ceil(reach_rad / steps).astype(int)
    axes = [np.linspace(-reach_rad, reach_rad, 2 * n + 1) for n in count]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def _excess(terms: Terms, poses: np.ndarray, kernel: KernelSettings) -> np.ndarray:
    """Score of each pose beyond what as many edges in the image score by chance, the clock as logged.

    Nearly all poses of a grid match by chance only, so the grid itself says what an edge scores by chance. Not counted,
    it decides: where chance costs, poses that turn the edges out of the image win, in the corners of a wide grid.
    """
    score, count = np.empty(len(poses)), np.empty(len(poses))
    for i in range(0, len(poses), _BATCH):
        batch = poses[i : i + _BATCH]
        at = Alignments(batch, np.zeros(len(batch)), np.ones(len(batch)))
        score[i : i + _BATCH], count[i : i + _BATCH] = terms.score(at, kernel).sum(1), terms.edges_in_view(at)
    chance = np.median(score[count > 0] / count[count > 0]) if (count > 0).any() else 0.0
    return score - chance * count


def _separate(turns: np.ndarray, score: np.ndarray, apart_rad: float) -> list[int]:
    """Indices of the highest scores that lie so far apart."""
    score = score.copy()
    found = []
    for _ in range(SCHEDULE.grid_maxima):
        i = int(np.argmax(score))
        if not np.isfinite(score[i]):
            break
        found.append(i)
        score[np.linalg.norm(turns - turns[i], axis=1) < apart_rad] = -np.inf
    return found

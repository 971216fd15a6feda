"""Exhaustive search over rotations: edges, markings and classes on a grid of rotations about a pose.

Scores with a narrow kernel have many maxima, scores with a wide one are biased. With a kernel of half a
degree, the score at the truth is well above all others. Over rotations alone, a grid of this resolution is
affordable: some thousands of poses at a few nanoseconds per point. Shifts within the prior's sigma move most
points by less than the kernel. A few points select the poses that are scored with all points.

Source: OpenCalib's CalibAnything (Luo et al. 2023) searches rotations by brute force too.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_lidar.beyond_chance import TERMS, Evidence
from pipeline.calibrate.joint.camera_lidar.schedule import SCHEDULE
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation

__all__ = ["GRID_SHIFTS_PX", "grid_kernel_rad", "grid_maxima", "grid_turns"]

# By so much the image is shifted to see what the same points show by chance: fewer than for the ends of the search.
GRID_SHIFTS_PX = ((-43.0, -37.0), (-31.0, 41.0), (29.0, -31.0), (43.0, 37.0))
TOGETHER = "all terms"


def grid_maxima(
    terms: Terms,
    prior: Prior,
    reach_rad: float,
    wrong: Float[np.ndarray, "P 4 4"],
    rng: np.random.Generator,
) -> list[tuple[str, Float[np.ndarray, "4 4"]]]:
    """Local maxima of a grid of rotations about the camera's axes, with the terms for which they are maxima.

    The order is: the best by all terms together, then each term's best, then others by all terms. The prior
    is the centre of the grid and keeps its translation; `wrong` are poses for the values of chance.
    """
    kernel_rad = grid_kernel_rad(reach_rad)
    kernel = KernelSettings.wide(kernel_rad * float(terms.camera[1]), 0, match=SCHEDULE.coarse_match)
    turns = grid_turns(reach_rad)
    rotations = exp_so3(turns) @ prior.T_camera_lidar[:3, :3]
    shifts = np.broadcast_to(prior.T_camera_lidar[:3, 3], (len(turns), 3))
    poses = from_rotation_translation(rotations, shifts)
    likely = -0.5 * ((turns / prior.rotation_sigma_rad) ** 2).sum(1)
    every = np.arange(0, terms.frames, -(-terms.frames // SCHEDULE.grid_frames))
    few = terms.of_frames(every).at_most(SCHEDULE.grid_points, rng)
    rough = Evidence(few, kernel).measured(wrong).of(poses)
    chosen = _highest(rough, likely)
    shown = Evidence(terms.at_most(SCHEDULE.chosen_points, rng), kernel, GRID_SHIFTS_PX).measured(wrong)
    evidence = shown.of(poses[chosen])
    apart_rad = SCHEDULE.grid_apart_kernels * kernel_rad
    best = _separate(turns[chosen], evidence.sum(1) + likely[chosen], apart_rad, SCHEDULE.grid_maxima)
    alone = [(name, int(np.argmax(evidence[:, k]))) for k, name in enumerate(TERMS)]
    found = [(TOGETHER, best[0]), *alone, *((TOGETHER, i) for i in best[1:])]
    return [(name, poses[chosen[i]]) for name, i in found]


def grid_kernel_rad(reach_rad: float) -> float:
    """Width of the kernel; a wider search range has a wider kernel."""
    is_wide = reach_rad > np.radians(SCHEDULE.wide_box_deg)
    return float(np.radians(SCHEDULE.wide_grid_kernel_deg if is_wide else SCHEDULE.grid_kernel_deg))


def grid_turns(reach_rad: float) -> Float[np.ndarray, "P 3"]:
    """Rotation vectors on a grid; roll moves points half as much as the others, so its step is twice as wide."""
    step = SCHEDULE.grid_step_kernels * grid_kernel_rad(reach_rad)
    steps = np.array([step, step, 2 * step])
    count = np.ceil(reach_rad / steps).astype(int)
    axes = [np.linspace(-reach_rad, reach_rad, 2 * n + 1) for n in count]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def _highest(evidence: Float[np.ndarray, "P 3"], likely: Float[np.ndarray, " P"]) -> np.ndarray:
    """Indices of the poses to score with all points: highest by all terms together, and by each alone."""
    some, few = (-min(n, len(evidence)) for n in SCHEDULE.grid_chosen)
    by_term = [np.argsort(evidence[:, k])[few:] for k in range(len(TERMS))]
    return np.unique(np.concatenate([np.argsort(evidence.sum(1) + likely)[some:], *by_term]))


def _separate(
    turns: Float[np.ndarray, "P 3"], score: Float[np.ndarray, " P"], apart_rad: float, most: int
) -> list[int]:
    """Indices of the highest scores with a minimum distance from each other."""
    score = score.copy()
    found = []
    for _ in range(most):
        i = int(np.argmax(score))
        if not np.isfinite(score[i]):
            break
        found.append(i)
        score[np.linalg.norm(turns - turns[i], axis=1) < apart_rad] = -np.inf
    return found

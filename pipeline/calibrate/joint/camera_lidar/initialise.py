"""Initial pose: the basin of the camera-lidar score, by restarts of a small differential evolution that must agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, Scored, refine
from pipeline.calibrate.joint.camera_lidar.schedule import SCHEDULE
from pipeline.calibrate.numerics.differential_evolution import evolve
from pipeline.calibrate.numerics.search_range import search_range
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse, log_so3
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms

__all__ = ["SAME_ROTATION_RAD", "Basin", "difference", "find_basin"]

SAME_ROTATION_RAD, _SAME_SHIFT_M = float(np.radians(0.4)), 0.15  # ends nearer than this are one optimum
_WIDE_RAD = np.radians(SCHEDULE.wide_box_deg)
_TIME_OFFSET_SIGMAS = 2.0  # half-width of the box
_COARSE = KernelSettings.wide(*SCHEDULE.coarse_kernel, match=SCHEDULE.coarse_match)
# Weight of class information [nats per point] against log likelihood ratios: over the box both then vary alike.
_CLASS_WEIGHT_PER_POINT = 0.12


@dataclass(frozen=True, eq=False)
class Basin:
    """The best end of all restarts, and how far the nearest of the others is from it."""

    state: AlignmentState
    restarts: int
    rotation_spread_rad: float
    translation_spread_m: float
    score_spread: float


def find_basin(
    terms: Terms,
    scored: Scored,
    rng: np.random.Generator,
) -> Basin:
    """Restart until another end agrees with the best one, at most `max_restarts` times.

    Args:
        terms: all points, for the evolution.
        scored: few sharp points, the widest kernel, the prior that is the centre of the search, and the config with
            the least search range; each restart is refined by it.
        rng: decides everything random.
    """
    ends: list[AlignmentState] = []
    while len(ends) < SCHEDULE.max_restarts:
        start = _evolved(terms, scored.prior, scored.config, rng)
        ends.append(refine(scored, start, steps=SCHEDULE.restart_steps))
        scores = [float(scored.terms.score(e.alone, scored.kernel).sum()) for e in ends]
        best = int(np.argmax(scores))
        others = [difference(e, ends[best]) for i, e in enumerate(ends) if i != best]
        apart = [(float(np.linalg.norm(d[:3])), float(np.linalg.norm(d[3:6]))) for d in others]
        agree = any(a < SAME_ROTATION_RAD and s < _SAME_SHIFT_M for a, s in apart)
        if len(ends) >= SCHEDULE.restarts and agree:
            break
    rotation, shift = min(apart)
    return Basin(ends[best], len(ends), rotation, shift, max(scores) - min(scores))


def difference(a: AlignmentState, b: AlignmentState) -> Float[np.ndarray, " 8"]:
    """Rotation vector, translation, dt and focal scale from b to a."""
    D = a.T_camera_lidar @ inverse(b.T_camera_lidar)
    shift = a.T_camera_lidar[:3, 3] - b.T_camera_lidar[:3, 3]
    return np.concatenate([log_so3(D[:3, :3]), shift, [a.dt_s - b.dt_s, a.focal - b.focal]])


def _evolved(terms: Terms, prior: Prior, config: SolveConfig, rng: np.random.Generator) -> AlignmentState:
    """Differential evolution in the search box, wide kernels, a random share of the points."""
    rotation, shift = search_range(prior, config)
    effort = SCHEDULE.wide_evolution if rotation > _WIDE_RAD else SCHEDULE.narrow_evolution
    population, generations, most = effort
    points = len(terms.edges.xyz_m) + len(terms.markings.xyz_m)
    thin = terms.thinned(min(1.0, most / max(points, 1)), rng)
    weight = _CLASS_WEIGHT_PER_POINT * (len(thin.edges.xyz_m) + len(thin.markings.xyz_m))
    T_0 = prior.T_camera_lidar
    dt_sigma_s = config.time_offset_sigma_s
    box = np.array([rotation] * 3 + [shift] * 3 + [_TIME_OFFSET_SIGMAS * dt_sigma_s])
    sigma = np.array([max(prior.rotation_sigma_rad, rotation / 2)] * 3 + [shift / 2] * 3 + [dt_sigma_s])

    def poses(x: np.ndarray) -> np.ndarray:
        return from_rotation_translation(exp_so3(x[:, :3]) @ T_0[:3, :3], T_0[:3, 3] + x[:, 3:6])

    def cost(x: np.ndarray) -> np.ndarray:
        at = Alignments(poses(x), x[:, 6], np.ones(len(x)))
        score = thin.score(at, _COARSE).sum(1) + weight * thin.class_information(at)
        return -score + 0.5 * ((x / sigma) ** 2).sum(1)

    x, _ = evolve(
        cost, -box, box, rng, population=population, generations=generations, start=np.zeros((1, 7))
    )
    return AlignmentState(poses(x[None])[0], float(x[6]))

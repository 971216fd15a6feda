"""Where to begin: the camera-lidar score's basin, by restarts of a small differential evolution that must agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, climb
from pipeline.calibrate.numerics.differential_evolution import evolve
from pipeline.calibrate.numerics.search_range import search_range
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse, log_so3
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms

__all__ = ["SAME_ROTATION_RAD", "Basin", "difference", "find_basin"]

_RESTARTS, _MOST_RESTARTS = 2, 6
SAME_ROTATION_RAD, _SAME_SHIFT_M = float(np.radians(0.4)), 0.15  # ends nearer than this are one optimum
# Population, generations, points: of a box of 6 deg about the prior, and of one of 20 or 30.
_NARROW, _WIDE, _WIDE_RAD = (48, 36, 6000), (64, 70, 9000), np.radians(9.0)
_SIGMAS_OF_CLOCK = 2.0
_STEPS = 10
_COARSE = KernelSettings.wide(10.0, 0, match=0.1)
# Nats per point of class information against log likelihood ratios: over the search box both then vary alike.
_CLASS_WEIGHT_PER_POINT = 0.12


@dataclass(frozen=True, eq=False)
class Basin:
    """The best of some ends, and how far the nearest of the others is from it."""

    state: AlignmentState
    restarts: int
    rotation_spread_rad: float
    translation_spread_m: float
    score_spread: float


def find_basin(
    terms: Terms,
    thin: Terms,
    first: KernelSettings,
    prior: Prior,
    config: SolveConfig,
    rng: np.random.Generator,
) -> Basin:
    """Restart until another end vouches for the best one, at most six times.

    Args:
        terms: all points, for the evolution.
        thin: few sharp points, for the ascent.
        first: the first and widest level of the ascent.
        prior: centre of the search, and weak information.
        config: least search range.
        rng: decides everything random.
    """
    ends: list[AlignmentState] = []
    while len(ends) < _MOST_RESTARTS:
        start = _evolved(terms, prior, config, rng)
        ends.append(climb(thin, start, first, prior, config, steps=_STEPS))
        scores = [float(thin.score(e.alone, first).sum()) for e in ends]
        best = int(np.argmax(scores))
        others = [difference(e, ends[best]) for i, e in enumerate(ends) if i != best]
        apart = [(float(np.linalg.norm(d[:3])), float(np.linalg.norm(d[3:6]))) for d in others]
        agree = any(a < SAME_ROTATION_RAD and s < _SAME_SHIFT_M for a, s in apart)
        if len(ends) >= _RESTARTS and agree:
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
    population, generations, most = _WIDE if rotation > _WIDE_RAD else _NARROW
    points = len(terms.edges.xyz_m) + len(terms.markings.xyz_m)
    thin = terms.thinned(min(1.0, most / max(points, 1)), rng)
    weight = _CLASS_WEIGHT_PER_POINT * (len(thin.edges.xyz_m) + len(thin.markings.xyz_m))
    T_0 = prior.T_camera_lidar
    clock = config.time_offset_sigma_s
    box = np.array([rotation] * 3 + [shift] * 3 + [_SIGMAS_OF_CLOCK * clock])
    sigma = np.array([max(prior.rotation_sigma_rad, rotation / 2)] * 3 + [shift / 2] * 3 + [clock])

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

"""Initial pose: which basin of the camera-lidar score the day shows, by candidates of different origin that must agree.

One search can be misled, and all its restarts alike: on days of other vehicles the maximum of a coarse score was not at
the truth but in a corner of the box, and every restart of the evolution ended there. So candidates come from several
origins (the prior itself, the vehicle's state, a grid of rotations on either half of the frames, a small differential
evolution), each climbs at the same kernel within the search range, their ends are compared at that same kernel, and
only the end of another origin vouches for the best one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, Scored, refine
from pipeline.calibrate.joint.camera_lidar.rotation_grid import grid_maxima
from pipeline.calibrate.joint.camera_lidar.schedule import SCHEDULE
from pipeline.calibrate.numerics.bias_floors import MAX_GAP_PX
from pipeline.calibrate.numerics.differential_evolution import evolve
from pipeline.calibrate.numerics.search_range import search_range
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse, log_so3, transform_points
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms

__all__ = ["Basin", "difference", "find_basin"]

# Ends that move the day's points by less than this (median angle), or by less than three quarters of the kernel at
# which they are compared, are one optimum: sharper kernels pull in as much.
_SAME_OPTIMUM_RAD, _SAME_OPTIMUM_KERNELS = float(np.radians(0.5)), 0.75
_POINTS = 500  # that show how far two ends are apart
_WIDE_RAD = np.radians(SCHEDULE.wide_box_deg)
_TIME_OFFSET_SIGMAS = 2.0  # half-width of the box
_SHIFT_SIGMAS = 3.0  # of the prior: where the evolution's first population lies
_COARSE = KernelSettings.wide(*SCHEDULE.coarse_kernel, match=SCHEDULE.coarse_match)
# Weight of class information [nats per point] against log likelihood ratios: over the box both then vary alike.
_CLASS_WEIGHT_PER_POINT = 0.12


@dataclass(frozen=True, eq=False)
class Basin:
    """The best end of all candidates, and how far the nearest end of another origin is from it."""

    state: AlignmentState
    second: AlignmentState | None  # the best one of another origin that agrees with it
    origin: str
    candidates: int
    vouched_by: tuple[str, ...]  # other origins whose ends agree with it
    apart_rad: float  # of the nearest end of another origin: median angle by which it moves the day's points
    score_lead: float  # over the best end elsewhere, as a share of its own score; 1 where there is none


@dataclass(frozen=True, eq=False)
class _End:
    """Where the climb from a candidate ended, and its score there at the common kernel."""

    origin: str
    state: AlignmentState
    score: float  # beyond chance


def find_basin(terms: Terms, scored: Scored, rng: np.random.Generator) -> Basin:
    """Climb from candidates until the end of another origin agrees with the best one, or all origins are exhausted.

    Args:
        terms: all points, for grid and evolution.
        scored: few sharp points, the kernel at which ends are compared, the prior that is the centre of the search,
            and the config with the least search range.
        rng: decides everything random.
    """
    kernel_rad = scored.kernel.sigma_px / float(scored.terms.camera[1])
    same_rad = max(_SAME_OPTIMUM_RAD, _SAME_OPTIMUM_KERNELS * kernel_rad)
    ends: list[_End] = []
    for origin, start in _candidates(terms, scored, rng):
        state = _climbed(scored, start)
        ends.append(_End(origin, state, _excess(scored, state)))
        best = max(ends, key=lambda e: e.score)
        apart = [_apart_rad(scored.terms, e.state, best.state) for e in ends]
        near = {e.origin for e, a in zip(ends, apart, strict=True) if a < same_rad}
        vouching = tuple(sorted(near - {best.origin}))
        # The prior alone does not end the search: where a grid was misled to its side, both climb to the same end.
        if len(near - {"prior"}) > 1:
            break
    others = [a for a, e in zip(apart, ends, strict=True) if e.origin != best.origin]
    elsewhere = [e.score for a, e in zip(apart, ends, strict=True) if a >= same_rad]
    lead = 1 - max(elsewhere, default=0.0) / best.score if best.score > 0 else 0.0
    state = refine(scored, best.state, steps=SCHEDULE.finishing_steps)
    agreeing = [e for e, a in zip(ends, apart, strict=True) if a < same_rad and e.origin != best.origin]
    second = max(agreeing, key=lambda e: e.score).state if agreeing else None
    return Basin(state, second, best.origin, len(ends), vouching, min(others, default=np.pi), float(lead))


def difference(a: AlignmentState, b: AlignmentState) -> Float[np.ndarray, " 8"]:
    """Rotation vector, translation, dt and focal scale from b to a."""
    D = a.T_camera_lidar @ inverse(b.T_camera_lidar)
    shift = a.T_camera_lidar[:3, 3] - b.T_camera_lidar[:3, 3]
    return np.concatenate([log_so3(D[:3, :3]), shift, [a.dt_s - b.dt_s, a.focal - b.focal]])


# -- candidates ------------------------------------------------------------------------------------------------------


def _candidates(
    terms: Terms, scored: Scored, rng: np.random.Generator
) -> Iterator[tuple[str, AlignmentState]]:
    """Starts with the name of their origin, those first that cost least."""
    prior, config = scored.prior, scored.config
    yield "prior", AlignmentState(prior.T_camera_lidar)
    reach = search_range(prior, config).rotation_rad
    # Each half of the frames by itself: what both show is no accident of one scene.
    sharp = terms.sharp(MAX_GAP_PX)
    halves = [sharp.of_frames(np.arange(k, terms.frames, 2)) for k in (0, 1)]
    grids = [grid_maxima(half, prior.T_camera_lidar, reach, rng) for half in halves]
    for name, grid in zip(("grid, even frames", "grid, odd frames"), grids, strict=True):
        yield name, AlignmentState(grid[0])
    yield "evolution", _evolved(terms, prior, config, rng)
    if prior.T_camera_lidar_before is not None:
        # Not before: whether an earlier day was calibrated already must not change a day whose own data agree.
        state = AlignmentState(prior.T_camera_lidar_before)
        yield "state", state.within(prior, search_range(prior, config))
    for _ in range(SCHEDULE.evolutions - 1):
        yield "evolution", _evolved(terms, prior, config, rng)
    for name, grid in zip(("grid, even frames", "grid, odd frames"), grids, strict=True):
        for T in grid[1:]:
            yield name, AlignmentState(T)


def _evolved(terms: Terms, prior: Prior, config: SolveConfig, rng: np.random.Generator) -> AlignmentState:
    """Differential evolution in the search box, wide kernels, a random share of the points."""
    rotation, shift = search_range(prior, config)
    shift = min(shift, _SHIFT_SIGMAS * prior.translation_sigma_m)
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


def _climbed(scored: Scored, start: AlignmentState) -> AlignmentState:
    """Where a start leads: at the grid's kernel first, where that is the wider one, then at the common kernel."""
    sigma_px = np.radians(SCHEDULE.grid_kernel_deg) * float(scored.terms.camera[1])
    if sigma_px > scored.kernel.sigma_px:
        wider = replace(scored, kernel=replace(scored.kernel, sigma_px=sigma_px))
        start = refine(wider, start, steps=SCHEDULE.wide_climb_steps)
    return refine(scored, start, steps=SCHEDULE.climb_steps)


# -- ends ------------------------------------------------------------------------------------------------------------


def _excess(scored: Scored, state: AlignmentState) -> float:
    """Score of an end beyond what chance would give it, at the kernel that all ends share."""
    edges = scored.kernel.edge_weight * scored.terms.edge_excess(state.alone, scored.kernel)
    markings = scored.kernel.marking_weight * scored.terms.marking_score(state.alone, scored.kernel)
    return float((edges + markings).sum())


def _apart_rad(terms: Terms, a: AlignmentState, b: AlignmentState) -> float:
    """Median angle by which the day's edges and markings lie elsewhere in the image.

    Not a distance of poses: a turn and a shift that move the points alike are one optimum's valley.
    """
    points = np.concatenate([terms.edges.xyz_m, terms.markings.xyz_m])
    points = points[:: max(1, len(points) // _POINTS)]
    u, v = (_directions(transform_points(s.T_camera_lidar, points)) for s in (a, b))
    return float(np.median(np.arccos(np.clip(np.sum(u * v, axis=1), -1, 1)))) if len(points) else 0.0


def _directions(points: np.ndarray) -> np.ndarray:
    return points / np.linalg.norm(points, axis=1, keepdims=True)

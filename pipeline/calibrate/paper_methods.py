"""The paper's optimisation methods: each pair alone, then all pairs refined together under the loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import differential_evolution, minimize

from pipeline.calibrate.numerics.covariance import OBSERVABLE, sandwich_covariance
from pipeline.calibrate.numerics.frame_blocks import scene_blocks
from pipeline.calibrate.numerics.nuisances import PAPER_BIAS
from pipeline.calibrate.reasons import because
from pipeline.core.config import SolveConfig
from pipeline.core.results import Progress, silent
from pipeline.objective.paper.camera_lidar import CameraLidarLoss, camera_lidar_loss
from pipeline.objective.paper.camera_radar import CameraRadarLoss, camera_radar_loss
from pipeline.objective.paper.classes import loop_loss, loop_transform
from pipeline.objective.paper.lidar_radar import LidarRadarLoss, lidar_radar_loss
from pipeline.rig.estimates import Check, PairEstimate, Prior, Solution, common_of
from pipeline.rig.se3 import changed, rotation_angle_rad
from schemas.calibrations import PAIRS
from schemas.observations import Observation

__all__ = [
    "Minimum", "PairProblem", "at_border", "estimate_of", "half_widths", "joint_costs", "loop_size",
    "minimise", "pair_problem", "solve_joint_optimisation", "solve_pair", "solve_pairwise",
]  # fmt: skip

# --------------------------------------------------------------------------------------------------
# Method `pairwise-optimisation`: each pair alone minimises the paper's loss.
#
# Source: sections 4.3 and 4.5.3, the row "pairwise optimization" of Table 1. Where the paper leaves open or
# we differ:
#
# - distances are `d^2 / (d^2 + s^2)` and terms are means per frame with weight 1: the paper says "smooth"
#   and "summed", and names neither function, scale nor weights;
# - "lidar detections" of the sky penalty are points of clusters: ground points never reach the sky within
#   the search box;
# - only points that stay in view when the prior is off by the search range are asked to lie in view: the
#   paper's lidar and radar see less than its camera, others see more;
# - "tracked clusters" include moving clusters of a single scan (with those seen twice only, two simulated
#   days err the same);
# - the radar's drivable area is perception's geometric free space where no network is configured;
# - frames below the paper's conditions fill up days that have too few above them, and the record counts
#   them;
# - the search box, 90 candidates and 60 generations of the evolution are ours.


@dataclass(frozen=True, eq=False)
class PairProblem:
    """One pair's loss over its frames."""

    pair: str
    T_prior: np.ndarray
    frame_losses: Callable[[np.ndarray], np.ndarray]  # (P, 4, 4) -> (P, F)
    informative: np.ndarray  # F
    blocks: np.ndarray  # F

    def loss(self, T: Float[np.ndarray, "P 4 4"]) -> Float[np.ndarray, " P"]:
        """Mean over the informative frames."""
        if not self.informative.any():
            return np.zeros(len(T))
        return np.asarray(self.frame_losses(T)[:, self.informative].mean(axis=1))


def pair_problem(
    pair: str, observations: Sequence[Observation], prior: Prior, config: SolveConfig
) -> PairProblem:
    """Prepare the paper's loss of one pair."""
    T, margin = prior.of(pair), np.radians(config.search_rotation_deg)
    loss: CameraLidarLoss | CameraRadarLoss | LidarRadarLoss
    if pair == "camera_lidar":
        loss = camera_lidar_loss(observations, T, margin)
    elif pair == "camera_radar":
        loss = camera_radar_loss(observations, T, margin)
    else:
        loss = lidar_radar_loss(observations)
    return PairProblem(pair, T, loss.frame_losses, loss.informative, scene_blocks(observations))


def solve_pairwise(
    observations: Mapping[str, Sequence[Observation]], prior: Prior, config: SolveConfig, *, seed: int,
    triggered: Sequence[str] = PAIRS, progress: Progress = silent,
) -> Solution:  # fmt: skip
    """Calibrate each triggered pair alone, each with its own random stream; others keep the prior."""
    pairs = {}
    for k, pair in enumerate(PAIRS):
        if pair not in observations:
            continue
        progress(k, len(PAIRS), f"{pair}: differential evolution")
        problem = pair_problem(pair, observations[pair], prior, config)
        minimum = solve_pair(problem, config, np.random.default_rng([seed, k])) if pair in triggered else None
        T = prior.of(pair) if minimum is None else changed(problem.T_prior, minimum.x)
        pairs[pair] = estimate_of(problem, T, prior, minimum)
    progress(len(PAIRS), len(PAIRS), "done")
    return Solution("pairwise-optimisation", pairs, *loop_size(pairs), failed_checks=border_failures(pairs))


def solve_pair(problem: PairProblem, config: SolveConfig, rng: np.random.Generator) -> Minimum:
    """Minimise one pair's loss about its prior."""
    return minimise(lambda x: problem.loss(changed(problem.T_prior, x)), config, np.zeros(6), rng)


def estimate_of(
    problem: PairProblem, T: Float[np.ndarray, "4 4"], prior: Prior, minimum: Minimum | None
) -> PairEstimate:
    """A pair's result with its covariance; `minimum` None = not calibrated, the prior stays."""
    base = prior.covariance(problem.pair)
    used = int(problem.informative.sum())
    blank = replace(PairEstimate.at_prior(problem.pair, prior), T=T, frames_used=used)
    if minimum is None:
        return replace(blank, notes=[because("not triggered")])
    losses = problem.loss(np.stack([problem.T_prior, T]))
    diagnostics = {
        "loss_prior": float(losses[0]),
        "loss_result": float(losses[1]),
        "evaluations": float(minimum.evaluations),
        "at_search_border": float(minimum.at_border),
    }
    floor = PAPER_BIAS[problem.pair]
    covariance, observability = sandwich_covariance(
        lambda poses: problem.frame_losses(poses)[:, problem.informative],
        T,
        problem.blocks[problem.informative],
        base,
        floor,
    )
    return replace(
        blank, covariance=covariance, observability=observability, observable=observability > OBSERVABLE,
        diagnostics=diagnostics, notes=[because("no uncertainty")],
        common_covariance=common_of(covariance, base, np.diag(np.square(np.repeat(floor, 3)))),
    )  # fmt: skip


def loop_size(pairs: Mapping[str, PairEstimate]) -> tuple[float | None, float | None]:
    """Angle [rad] and translation [m] of the loop of the pair estimates; None without three."""
    if len(pairs) < len(PAIRS):
        return None, None
    loop = loop_transform(pairs["camera_lidar"].T, pairs["lidar_radar"].T, pairs["camera_radar"].T)
    return float(rotation_angle_rad(loop)), float(np.linalg.norm(loop[:3, 3]))


def border_failures(pairs: Mapping[str, PairEstimate]) -> dict[str, list[Check]]:
    """A minimum at the border of the search box is none: the loss may fall further outside."""
    return {
        pair: [Check(because("border"))]
        for pair, estimate in pairs.items()
        if estimate.diagnostics.get("at_search_border")
    }


# --------------------------------------------------------------------------------------------------
# Method `joint-optimisation`: the pairwise results refined together under the loop, `(1 + L_P)(1 + L_G)`.
#
# L_P sums the losses of the triggered pairs; the others stay at the prior and still close the loop.
#
# Source: section 4.5.3, equations 1 and 2, the row "joint optimization" of Table 1. Differences are those
# of `pairwise`, and one more: in L_P each pair's loss is divided by the value of its pairwise minimum,
# unless `solve.paper_loss_scale` is "none": equation 2 to the letter. Neither is better in every cell: the
# study table1 reports both.


# First population of the joint search: this share of the box about the pairwise result (1.2 deg of 6).
_SPREAD = 0.2


def solve_joint_optimisation(
    observations: Mapping[str, Sequence[Observation]], prior: Prior, config: SolveConfig, *, seed: int,
    triggered: Sequence[str] = PAIRS, progress: Progress = silent,
) -> Solution:  # fmt: skip
    """Pairwise first, then all triggered pairs at once with the loop; arguments as in `solve_pairwise`."""
    active = [pair for pair in PAIRS if pair in triggered]
    problems = {pair: pair_problem(pair, observations[pair], prior, config) for pair in PAIRS}
    starts = []
    scales = {}
    for k, pair in enumerate(active):
        progress(k, len(active) + 1, f"{pair}: differential evolution")
        alone = solve_pair(problems[pair], config, np.random.default_rng([seed, PAIRS.index(pair)]))
        starts.append(alone.x)
        scales[pair] = max(alone.value, 1e-6) if config.paper_loss_scale == "pairwise_minimum" else 1.0
    progress(len(active), len(active) + 1, "all pairs with the loop")
    pairs = {pair: estimate_of(problems[pair], prior.of(pair), prior, None) for pair in PAIRS}
    if active:
        found = minimise(
            lambda x: joint_costs(problems, prior, scales, x),
            config,
            np.concatenate(starts),
            np.random.default_rng([seed, len(PAIRS)]),
            spread=_SPREAD,
        )
        for pair, x in zip(active, found.x.reshape(-1, 6), strict=True):
            own = replace(found, x=x, at_border=at_border(x, half_widths(config, 1)))
            pairs[pair] = estimate_of(problems[pair], changed(prior.of(pair), x), prior, own)
    return Solution("joint-optimisation", pairs, *loop_size(pairs), failed_checks=border_failures(pairs))


def joint_costs(
    problems: Mapping[str, PairProblem],
    prior: Prior,
    scales: Mapping[str, float],
    x: Float[np.ndarray, "S D"],
) -> Float[np.ndarray, " S"]:
    """Equation 2 for a batch of parameter vectors, six numbers per pair of `scales` about its prior.

    Each pair's loss is divided by its scale, the value of its pairwise minimum (1 = equation 2 to the letter): the
    paper names no weights, and unweighted the pair with the largest unexplained rest, not the best determined one,
    decides.
    """
    poses = {pair: np.broadcast_to(prior.of(pair), (len(x), 4, 4)) for pair in PAIRS}
    for k, pair in enumerate(scales):
        poses[pair] = changed(prior.of(pair), x[:, 6 * k : 6 * k + 6])
    pairwise = sum(
        (problems[pair].loss(poses[pair]) / scale for pair, scale in scales.items()), np.zeros(len(x))
    )
    loop = loop_transform(poses["camera_lidar"], poses["lidar_radar"], poses["camera_radar"])
    return (1 + pairwise) * (1 + loop_loss(loop))  # equation 2


# --------------------------------------------------------------------------------------------------
# Differential evolution, then Nelder-Mead: the paper's optimiser (section 4.5.3) over poses about a start.
#
# A pose is six numbers about its start: a rotation vector in the parent's axes [rad] on the rotation part
# alone, and a shift of the origin [m]. The search range has the same meaning for any lever arm.

# Costs of a batch of parameter vectors: (S, D) -> (S,)
Objective = Callable[[np.ndarray], np.ndarray]


_BORDER = 0.98  # of the half-width: a minimum beyond it counts as at the border
_SIMPLEX = 0.05  # edge of Nelder-Mead's first simplex, as a share of the half-width
_EVALUATIONS_PER_PARAMETER = 150


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where the search ended."""

    x: np.ndarray
    value: float
    evaluations: int
    at_border: bool  # within 2 % of the box: the true minimum may lie outside


def half_widths(config: SolveConfig, poses: int) -> Float[np.ndarray, " D"]:
    """Half the search box along each parameter of `poses` poses."""
    return np.tile([np.radians(config.search_rotation_deg)] * 3 + [config.search_translation_m] * 3, poses)


def minimise(
    objective: Objective, config: SolveConfig, start: Float[np.ndarray, " D"], rng: np.random.Generator, *,
    spread: float = 1.0,
) -> Minimum:  # fmt: skip
    """Minimise over the box: differential evolution (best1bin) on whole generations, then Nelder-Mead from its best.

    Args:
        start: member of the first population, and its centre.
        spread: size of the first population as a share of the box, 1 = all of it.
    """
    half = half_widths(config, len(start) // 6)
    members = start + spread * half * (2 * _latin_hypercube(config.paper_population, len(start), rng) - 1)
    members = np.clip(members, -half, half)
    members[0] = np.clip(start, -half, half)
    evaluations = 0

    def counted(x: np.ndarray) -> np.ndarray:
        nonlocal evaluations
        evaluations += len(x)
        return objective(np.clip(x, -half, half))

    found = differential_evolution(
        lambda x: counted(x.T), list(zip(-half, half, strict=True)), init=members,
        maxiter=config.paper_generations, mutation=(0.5, 0.9), recombination=0.8, tol=1e-4, polish=False,
        vectorized=True, updating="deferred", rng=rng,
    )  # fmt: skip
    simplex = np.vstack([found.x, found.x + np.diag(_SIMPLEX * half)])
    finished = minimize(
        lambda x: float(counted(x[None])[0]),
        found.x,
        method="Nelder-Mead",
        options={
            "initial_simplex": simplex,
            "xatol": 1e-5,  # 0.0006 deg, 0.01 mm
            "fatol": 1e-7,
            "maxfev": _EVALUATIONS_PER_PARAMETER * len(start),
            "adaptive": len(start) > 6,
        },
    )
    x = np.clip(finished.x, -half, half)
    return Minimum(x, float(finished.fun), evaluations, at_border(x, half))


def at_border(x: Float[np.ndarray, " D"], half_widths: Float[np.ndarray, " D"]) -> bool:
    """Whether a minimum is so near the border of the box that the true one may be outside."""
    return bool(np.any(np.abs(x) > _BORDER * half_widths))


def _latin_hypercube(members: int, dimensions: int, rng: np.random.Generator) -> np.ndarray:
    strata = np.argsort(rng.random((dimensions, members)), axis=1).T
    return (strata + rng.random((members, dimensions))) / members

"""The paper's optimisation methods: each pair alone, then all pairs refined together under the loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.calibrate.numerics.bias_floors import PAPER_BIAS
from pipeline.calibrate.numerics.covariance import OBSERVABLE
from pipeline.calibrate.numerics.frame_blocks import scene_blocks
from pipeline.calibrate.paper.minimise import Minimum, at_border, half_widths, minimise
from pipeline.core.config import SolveConfig
from pipeline.core.results import Progress, silent
from pipeline.objective.paper.camera_lidar import CameraLidarLoss, camera_lidar_loss
from pipeline.objective.paper.camera_radar import CameraRadarLoss, camera_radar_loss
from pipeline.objective.paper.classes import loop_loss, loop_transform
from pipeline.objective.paper.lidar_radar import LidarRadarLoss, lidar_radar_loss
from pipeline.rig.changes import changed
from pipeline.rig.checks import Check
from pipeline.rig.common_share import common_of
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.se3 import exp_se3, rotation_angle_rad
from schemas.calibrations import PAIRS
from schemas.observations import Observation

__all__ = [
    "PairProblem",
    "estimate_of",
    "joint_costs",
    "loop_size",
    "pair_problem",
    "sandwich_covariance",
    "solve_joint_optimisation",
    "solve_pair",
    "solve_pairwise",
]

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
#
# Covariance of a minimum of the paper's losses: block sandwich from curvature and the scatter of gradients.
#
# The paper gives no uncertainty. The sandwich `H^-1 S H^-1` (H: curvature of the mean loss, S: scatter of
# the gradients over blocks of frames that share a scene) is what resampling whole blocks converges to, at
# the price of a few evaluations; its inverse is added to the prior's information. It does not include bias,
# and these losses are biased (their minimum lies below the truth's value): a floor measured in simulation
# is added.


NO_UNCERTAINTY = (
    "the paper gives no uncertainty: block sandwich of its loss plus a bias floor from simulation"
)
_STEP = np.array([np.radians(0.2)] * 3 + [0.04] * 3)


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
    observations: Mapping[str, Sequence[Observation]],
    prior: Prior,
    config: SolveConfig,
    *,
    seed: int,
    triggered: Sequence[str] = PAIRS,
    progress: Progress = silent,
) -> Solution:
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
        return replace(blank, notes=["not triggered: keeps the prior"])
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
        blank,
        covariance=covariance,
        observability=observability,
        observable=observability > OBSERVABLE,
        diagnostics=diagnostics,
        notes=[NO_UNCERTAINTY],
        common_covariance=common_of(covariance, base, np.diag(np.square(np.repeat(floor, 3)))),
    )


def loop_size(pairs: Mapping[str, PairEstimate]) -> tuple[float | None, float | None]:
    """Angle [rad] and translation [m] of the loop of the pair estimates; None without three."""
    if len(pairs) < len(PAIRS):
        return None, None
    loop = loop_transform(pairs["camera_lidar"].T, pairs["lidar_radar"].T, pairs["camera_radar"].T)
    return float(rotation_angle_rad(loop)), float(np.linalg.norm(loop[:3, 3]))


def border_failures(pairs: Mapping[str, PairEstimate]) -> dict[str, list[Check]]:
    """A minimum at the border of the search box is none: the loss may fall further outside."""
    return {
        pair: [Check("the minimum lies at the border of the search range")]
        for pair, estimate in pairs.items()
        if estimate.diagnostics.get("at_search_border")
    }


def sandwich_covariance(
    frame_losses: Callable[[np.ndarray], np.ndarray],
    T: Float[np.ndarray, "4 4"],
    blocks: Int[np.ndarray, " F"],
    prior_covariance: Float[np.ndarray, "6 6"],
    floor: tuple[float, float],
) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, " 6"]]:
    """Covariance (left perturbation, rotation first) with the bias floor, and observability per DoF.

    Args:
        frame_losses: (P, 4, 4) -> (P, F).
        prior_covariance: upper limit for what is not determined.
        floor: bias floor, rotation [rad] and translation [m].

    Returns:
        Covariance, and 1 - variance / prior variance per DoF, clipped to 0..1.
    """
    E = np.diag(_STEP)
    plus, minus = frame_losses(exp_se3(E) @ T), frame_losses(exp_se3(-E) @ T)
    gradients = (plus - minus) / (2 * _STEP[:, None])  # 6 F
    frames = gradients.shape[1]
    names = np.unique(blocks)
    sums = np.stack([gradients[:, blocks == b].sum(axis=1) for b in names]) / frames
    sums -= sums.mean(axis=0)
    S = sums.T @ sums * len(names) / max(len(names) - 1, 1)
    H = _curvature(frame_losses, T, plus.mean(axis=1), minus.mean(axis=1))
    information = _godambe(H, S) + np.linalg.inv(prior_covariance)
    covariance = np.linalg.inv(information) + np.diag([floor[0] ** 2] * 3 + [floor[1] ** 2] * 3)
    covariance = (covariance + covariance.T) / 2
    observability = np.clip(1 - np.diag(covariance) / np.diag(prior_covariance), 0, 1)
    return covariance, observability


def _curvature(
    frame_losses: Callable[[np.ndarray], np.ndarray], T: np.ndarray, plus: np.ndarray, minus: np.ndarray
) -> np.ndarray:
    centre = frame_losses(T[None]).mean()
    H = np.diag((plus + minus - 2 * centre) / _STEP**2)
    for i in range(6):
        for j in range(i):
            signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]], float)
            xi = np.zeros((4, 6))
            xi[:, [i, j]] = signs * _STEP[[i, j]]
            f = frame_losses(exp_se3(xi) @ T).mean(axis=1)
            H[i, j] = H[j, i] = (f[0] - f[1] - f[2] + f[3]) / (4 * _STEP[i] * _STEP[j])
    return H


def _godambe(H: np.ndarray, S: np.ndarray) -> np.ndarray:
    """H S^-1 H, the inverse of the sandwich; 0 in directions in which both H and S vanish."""
    scale = _STEP[:, None] * _STEP[None]
    values, vectors = np.linalg.eigh(H * scale)
    positive = (vectors * np.maximum(values, 0)) @ vectors.T
    scatter = S * scale
    floor = 1e-3 * max(float(np.linalg.eigvalsh(scatter).max()), 1e-15)
    return positive @ np.linalg.solve(scatter + floor * np.eye(6), positive) / scale


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
    observations: Mapping[str, Sequence[Observation]],
    prior: Prior,
    config: SolveConfig,
    *,
    seed: int,
    triggered: Sequence[str] = PAIRS,
    progress: Progress = silent,
) -> Solution:
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

"""Method `joint-optimisation`: the pairwise results refined together under the loop, `(1 + L_P)(1 + L_G)`.

L_P sums the losses of the triggered pairs; the others stay at the prior and still close the loop.

Source: section 4.5.3, equations 1 and 2, the row "joint optimization" of Table 1. Differences are those of `pairwise`,
and one more: in L_P each pair's loss is divided by the value of its pairwise minimum, unless `solve.paper_loss_scale`
is "none": equation 2 to the letter. Neither is better in every cell: the study table1 reports both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.paper.minimise import at_border, half_widths, minimise
from pipeline.calibrate.paper.pairwise import (
    PairProblem,
    border_failures,
    estimate_of,
    loop_size,
    pair_problem,
    solve_pair,
)
from pipeline.core.config import SolveConfig
from pipeline.core.results import Progress, silent
from pipeline.objective.paper.loop import joint_objective, loop_loss, loop_transform
from pipeline.rig.changes import changed
from pipeline.rig.estimates import Prior, Solution
from schemas.calibrations import PAIRS
from schemas.observations import Observation

__all__ = ["joint_costs", "solve_joint_optimisation"]

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
    return joint_objective(pairwise, loop_loss(loop))

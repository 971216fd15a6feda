"""The camera's clock: the score's profile over the time offset, with the log's focal length.

What the car passes grows in the image with time as it does with focal length, and as it does along the optical axis.
Left free together, the three wander along their valley: on simulated highways the focal length by 2 %, six of its
sigmas, and the clock by 20 to 30 ms. With the focal length at the log's and tz where it was settled, edges tell the
time to a few milliseconds. So the clock is stepped both ways through its valley, the pose is solved again at each step,
and what focal length and tz leave open is carried into its sigma.

Sources: profile likelihood: Murphy & van der Vaart 2000; parameters considered, not solved for: Schmidt 1966.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, climb, prior_value, scales
from pipeline.calibrate.numerics.response_surface import DESIGN
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.objective.camera_lidar.score import KernelSettings, Terms

__all__ = ["DT", "FOCAL", "ClockProfile", "profile_clock", "s_per_metre"]

DT, FOCAL = 6, 7
_STEP_M, _STEP_S = 0.2, 0.012  # steps of time in metres of way, and at most
_REACH_S = 0.05
_RESAMPLES = 200
_SLOW_MPS = 2.0  # at such speeds a shift along the axis is not asked of the clock
_FIXED = np.isin(np.arange(8), (DT, FOCAL))


@dataclass(frozen=True, eq=False)
class ClockProfile:
    """The best state of the profile, and the variance of its clock over resampled frames."""

    state: AlignmentState
    variance_s2: float


def s_per_metre(terms: Terms, state: AlignmentState) -> float:
    """How much later the image must be where the camera's tz is a metre more, for what stands to stay where it is."""
    forward_mps = terms.velocity_lidar @ state.T_camera_lidar[2, :3]
    return float(forward_mps.sum() / (np.sum(forward_mps**2) + len(forward_mps) * _SLOW_MPS**2))


def profile_clock(
    terms: Terms,
    state: AlignmentState,
    level: KernelSettings,
    prior: Prior,
    config: SolveConfig,
    held: Bool[np.ndarray, " 8"],
) -> ClockProfile:
    """Step the clock away from a solution to both sides, as long as that helps, and solve the pose at each step.

    Args:
        terms: points.
        state: a solution; its focal length is put back to the log's.
        level: sharp level, weighted.
        prior: of the pose and the clock.
        config: prior of the clock.
        held: of the pose, besides.
    """
    speed_mps = float(np.sqrt(np.mean(np.sum(terms.velocity_lidar**2, axis=1))))
    step_s = min(_STEP_M / max(speed_mps, 1.0), _STEP_S)
    fixed = held | _FIXED
    start = climb(terms, replace(state, focal=1.0), level, prior, config, steps=2, held=fixed)
    ends = {0: start}
    scores = {0: _frame_scores(terms, start, level, prior, config)}
    for sign in (1, -1):
        here = start
        for k in range(1, 2 * int(np.ceil(_REACH_S / step_s))):
            best = max(scores, key=lambda n: scores[n].sum())
            if k * step_s > _REACH_S and abs(sign * k - best) * step_s > _REACH_S / 2:
                break
            moved = replace(here, dt_s=start.dt_s + sign * k * step_s)
            here = climb(terms, moved, level, prior, config, steps=1, held=fixed)
            ends[sign * k], scores[sign * k] = here, _frame_scores(terms, here, level, prior, config)
    steps = np.array(sorted(ends))
    score = np.column_stack([scores[k] for k in steps])
    k = int(np.argmax(score.sum(0)))
    top = _top(score.sum(0)[None])[0]
    # Another sample of streets might have another of the valley's tops.
    drawn = np.random.default_rng(0).multinomial(
        len(score), np.full(len(score), 1 / len(score)), size=_RESAMPLES
    )
    spread = float(np.mean((_top(drawn @ score) - top) ** 2))
    found = replace(ends[int(steps[k])], dt_s=start.dt_s + (top + steps[0]) * step_s)
    return ClockProfile(found, spread * step_s**2)


def _top(value: Float[np.ndarray, "S N"]) -> Float[np.ndarray, " S"]:
    """Where each row is highest, in steps: the top of the parabola through the highest value and its neighbours."""
    k = np.argmax(value, axis=1)
    inner = np.clip(k, 1, value.shape[1] - 2)
    before, at, after = (value[np.arange(len(value)), inner + d] for d in (-1, 0, 1))
    curvature = np.maximum(2 * at - before - after, 1e-9)
    return np.where(inner == k, k + 0.5 * (after - before) / curvature, k)


def _frame_scores(
    terms: Terms, state: AlignmentState, level: KernelSettings, prior: Prior, config: SolveConfig
) -> Float[np.ndarray, " F"]:
    """Score of each frame, mean over a ball in which it is rough, and its share of the prior."""
    ball = DESIGN * np.where(_FIXED, 0.0, scales(terms, level))
    score = terms.score(state.changed(ball), level).mean(0)
    return score + float(prior_value(state.alone, prior, config)[0]) / len(score)

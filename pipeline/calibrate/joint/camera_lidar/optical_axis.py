"""How far along the optical axis: the score's profile over tz, wide enough to see through its roughness.

Fast cars hardly tell tz from the clock, and the focal length follows both: a valley decimetres long, in which the score
is rough at the scale of a response surface. Its gradients scatter in every direction and promise centimetres that the
valley does not hold. So tz is stepped through the valley, the others are solved again at each step, and a parabola says
where the valley is deepest and how surely.

Edges and markings are judged apart on the same path. They err in different ways (lane paint slides along its lane and
blurs with distance): with errors of its own for each, of equal size, the mean of both errs by half of their difference,
and where one of them hardly sees tz, the bias of the other is not known better than that.

Sources: profile likelihood: Murphy & van der Vaart 2000; what disagrees beyond its sigmas: Birge 1932.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, climb, prior_value, scales
from pipeline.calibrate.numerics.response_surface import DESIGN
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.objective.camera_lidar.score import KernelSettings, Terms

__all__ = ["TZ", "Profile", "profile_tz", "with_tz"]

TZ = 5
_STEPS = 3  # to each side
_SPAN_M = 0.36
# RMS distance of tz from the reference on halves of a real day of 16 rings: where nothing checks it.
_UNCHECKED_M = 0.18
# What edges and markings err by alike, which their distance cannot show: RMS error where they agreed, simulated days
# of seeds 110 to 125.
_ALIKE_M = 0.05


@dataclass(frozen=True, eq=False)
class Profile:
    """What the day alone says of tz: value, variance from the valley's shape, bias that two kinds of evidence show."""

    tz_m: float
    variance_m2: float  # infinite where the profile has no top
    bias_m: float
    kinds_apart_m: float  # markings alone less edges alone
    kinds_sigma_m: float

    def with_prior(self, tz_m: float, sigma_m: float) -> tuple[float, float]:
        """Value and variance together with a prior."""
        variance = self.variance_m2 + self.bias_m**2 + _ALIKE_M**2
        weight = 1 / (1 + variance / sigma_m**2)
        return tz_m + weight * (self.tz_m - tz_m), (1 - weight) * sigma_m**2


def profile_tz(
    terms: Terms,
    state: AlignmentState,
    level: KernelSettings,
    prior: Prior,
    config: SolveConfig,
    follow: Float[np.ndarray, " 8"],
) -> Profile:
    """Step tz away from a solution to both sides and solve the others at each step.

    Args:
        terms: points.
        state: a solution with tz free.
        level: sharp level, weighted.
        prior: of the others.
        config: prior of the clock.
        follow: how far the others move when tz moves by one.
    """
    held = np.arange(8) == TZ
    centre = float(state.T_camera_lidar[2, 3])
    tz, values = [], []
    for sign in (1.0, -1.0):
        here = state
        for k in range(0 if sign > 0 else 1, _STEPS + 1):
            at = centre + sign * k * _SPAN_M / _STEPS
            moved = with_tz(prior, at)
            here = climb(
                terms,
                here.stepped(follow * (at - here.T_camera_lidar[2, 3])),
                level,
                moved,
                config,
                steps=1,
                held=held,
            )
            tz.append(at)
            values.append(_smooth_values(terms, here, level, moved, config))
    edges, markings, others = np.array(values).T
    x = np.array(tz) - centre
    top, variance = _top(x, edges + markings + others)
    (top_e, variance_e), (top_m, variance_m) = _top(x, edges), _top(x, markings)
    apart, sigma = top_m - top_e, float(np.sqrt(variance_e + variance_m))
    if np.isfinite(sigma):
        bias = float(np.sqrt(max(apart**2 - sigma**2, 0.0) / 4 + min(_UNCHECKED_M, sigma / 2) ** 2))
    else:
        bias = _UNCHECKED_M
    return Profile(centre + top, variance, bias, apart, min(sigma, 9.99))


def with_tz(prior: Prior, tz_m: float) -> Prior:
    """A prior with another tz: what is held stays there."""
    T = prior.T_camera_lidar.copy()
    T[2, 3] = tz_m
    return replace(prior, T_camera_lidar=T)


def _smooth_values(
    terms: Terms, state: AlignmentState, level: KernelSettings, prior: Prior, config: SolveConfig
) -> tuple[float, float, float]:
    """Score of edges and of markings, means over a ball in which the score is rough, and the others' prior."""
    at = state.changed(DESIGN * np.where(np.arange(8) == TZ, 0.0, scales(terms, level)))
    edges = level.edge_weight * float(terms.edge_score(at, level).sum(1, dtype=np.float64).mean())
    markings = level.marking_weight * float(terms.marking_score(at, level).sum(1, dtype=np.float64).mean())
    return edges, markings, float(prior_value(state.alone, prior, config)[0])


def _top(x: Float[np.ndarray, " N"], value: Float[np.ndarray, " N"]) -> tuple[float, float]:
    """Where a parabola through a rough profile is highest, within twice the span, and the variance of that place."""
    A = np.column_stack([np.ones_like(x), x, -0.5 * x * x])
    (_, slope, curvature), residual, *_ = np.linalg.lstsq(A, value, rcond=None)
    if curvature <= 0:
        return 0.0, float("inf")
    noise = float(residual[0]) / (len(x) - 3) if len(residual) else 0.0
    top = float(np.clip(slope / curvature, -2 * _SPAN_M, 2 * _SPAN_M))
    spread = noise * np.linalg.inv(A.T @ A)
    of_top = np.array([0.0, 1.0, -top]) / curvature
    return top, float(1 / curvature + of_top @ spread @ of_top)

"""Position along the optical axis (tz), by a profile of the score that is wide compared with its roughness.

On fast cars tz hardly differs from the time offset, and the focal length follows both: a valley decimetres
long, in which the score is rough at the scale of a response surface. Its gradients scatter in every direction
and predict a sigma of centimetres, which is too small. tz is therefore stepped through the valley, the other
unknowns are solved again at each step, and a parabola gives the maximum and its sigma.

Edges and markings are compared on the same path, because their biases differ (lane paint is uniform along its
lane and blurs with distance). If both have independent errors of equal size, the error of the mean is half of
their difference. If one of them hardly depends on tz, the other's bias is not known better than that.

Sources: profile likelihood: Murphy & van der Vaart 2000; disagreement beyond the sigmas: Birge 1932.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, Scored, prior_value, refine, scales
from pipeline.calibrate.joint.camera_lidar.schedule import SCHEDULE
from pipeline.calibrate.numerics.bias_floors import TZ_COMMON_BIAS_M, TZ_UNCHECKED_BIAS_M
from pipeline.calibrate.numerics.response_surface import DESIGN
from pipeline.rig.estimates import Prior

__all__ = ["TZ", "TzProfile", "profile_tz", "with_tz"]

TZ = 5  # of the eight unknowns
_MAX_SIGMA_M = 9.99  # of what a record shows
_REACH = 2  # spans, within which a parabola's top is looked for


@dataclass(frozen=True, eq=False)
class TzProfile:
    """tz from the day alone: value, variance from the profile, bias from the difference of edges and markings."""

    tz_m: float
    variance_m2: float  # infinite where the profile has no maximum
    bias_m: float
    kinds_apart_m: float  # tz by markings alone less tz by edges alone
    kinds_sigma_m: float
    is_beyond: bool = False  # the parabola's top is too far off to be used

    def shift_from(self, tz_m: float) -> tuple[float, float] | None:
        """Shift of the day's own tz from a prior, and its sigma [m]; None if the day does not determine it."""
        sigma = float(np.sqrt(self.variance_m2 + self.bias_m**2 + TZ_COMMON_BIAS_M**2))
        return None if self.is_beyond or not np.isfinite(sigma) else (self.tz_m - tz_m, sigma)

    def with_prior(self, tz_m: float, sigma_m: float) -> tuple[float, float, float]:
        """Value [m] and variance [m2] combined with a prior, and the share of the variance common to all days."""
        bias = self.bias_m**2 + TZ_COMMON_BIAS_M**2
        variance = self.variance_m2 + bias
        weight = 1 / (1 + variance / sigma_m**2)
        total = (1 - weight) * sigma_m**2
        common = weight**2 * bias + (1 - weight) ** 2 * sigma_m**2
        return tz_m + weight * (self.tz_m - tz_m), total, common / total


def profile_tz(scored: Scored, state: AlignmentState, follow: Float[np.ndarray, " 8"]) -> TzProfile:
    """Step tz away from a solution to both sides and solve the others at each step.

    `follow` is the change of the others per metre of tz.
    """
    fixed = np.arange(8) == TZ
    centre = float(state.T_camera_lidar[2, 3])
    tz, values = [], []
    for sign in (1.0, -1.0):
        here = state
        for k in range(0 if sign > 0 else 1, SCHEDULE.tz_values_per_side + 1):
            at = centre + sign * k * SCHEDULE.tz_span_m / SCHEDULE.tz_values_per_side
            there = replace(scored, prior=with_tz(scored.prior, at))
            start = here.stepped(follow * (at - here.T_camera_lidar[2, 3]))
            here = refine(there, start, steps=SCHEDULE.profile_steps, fixed=fixed)
            tz.append(at)
            values.append(_smooth_values(there, here))
    edges, markings, others = np.array(values).T
    x = np.array(tz) - centre
    top, variance = _maximum(x, edges + markings + others)
    (top_e, variance_e), (top_m, variance_m) = _maximum(x, edges), _maximum(x, markings)
    apart, sigma = top_m - top_e, float(np.sqrt(variance_e + variance_m))
    if np.isfinite(sigma):
        unchecked = min(TZ_UNCHECKED_BIAS_M, sigma / 2)
        bias = float(np.sqrt(max(apart**2 - sigma**2, 0.0) / 4 + unchecked**2))
    else:
        bias = TZ_UNCHECKED_BIAS_M
    is_beyond = abs(top) >= _REACH * SCHEDULE.tz_span_m
    return TzProfile(centre + top, variance, bias, apart, min(sigma, _MAX_SIGMA_M), is_beyond)


def with_tz(prior: Prior, tz_m: float) -> Prior:
    """A prior with another tz, at which tz is fixed."""
    T = prior.T_camera_lidar.copy()
    T[2, 3] = tz_m
    return replace(prior, T_camera_lidar=T)


def _smooth_values(scored: Scored, state: AlignmentState) -> tuple[float, float, float]:
    """Scores of edges and of markings, averaged over a ball because they are rough, and the prior of the others."""
    terms, kernel = scored.terms, scored.kernel
    at = state.changed(DESIGN * np.where(np.arange(8) == TZ, 0.0, scales(terms, kernel)))
    edges = kernel.edge_weight * float(terms.edge_score(at, kernel).sum(1, dtype=np.float64).mean())
    markings = kernel.marking_weight * float(terms.marking_score(at, kernel).sum(1, dtype=np.float64).mean())
    return edges, markings, float(prior_value(state.alone, scored.prior, scored.config)[0])


def _maximum(x: Float[np.ndarray, " N"], value: Float[np.ndarray, " N"]) -> tuple[float, float]:
    """Maximum of a parabola through a rough profile, within twice the span, and its variance."""
    A = np.column_stack([np.ones_like(x), x, -0.5 * x * x])
    (_, slope, curvature), residual, *_ = np.linalg.lstsq(A, value, rcond=None)
    if curvature <= 0:
        return 0.0, float("inf")
    noise = float(residual[0]) / (len(x) - 3) if len(residual) else 0.0
    reach = _REACH * SCHEDULE.tz_span_m
    top = float(np.clip(slope / curvature, -reach, reach))
    spread = noise * np.linalg.inv(A.T @ A)
    J_top = np.array([0.0, 1.0, -top]) / curvature
    return top, float(1 / curvature + J_top @ spread @ J_top)

"""Unknowns whose score is no parabola, by profiles: tz, the time offset, and that without either half of the image."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import median_filter

from pipeline.calibrate.joint.camera_lidar.initialise import difference
from pipeline.calibrate.joint.camera_lidar.refine import (
    SCHEDULE,
    AlignmentState,
    Scored,
    prior_value,
    refine,
    scales,
)
from pipeline.calibrate.numerics.covariance import DESIGN
from pipeline.calibrate.numerics.nuisances import TZ_COMMON_BIAS_M, TZ_UNCHECKED_BIAS_M
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms
from pipeline.rig.estimates import Prior

__all__ = [
    "DT",
    "FOCAL",
    "TZ",
    "TimeOffsetProfile",
    "TzProfile",
    "compared_terms",
    "far_time_offset",
    "frame_scores",
    "left_out_in_time",
    "maximum",
    "profile_time_offset",
    "profile_tz",
    "s_per_metre",
    "with_tz",
]

# --------------------------------------------------------------------------------------------------
# Position along the optical axis (tz), by a profile of the score that is wide compared with its roughness.
#
# On fast cars tz hardly differs from the time offset, and the focal length follows both: a valley decimetres
# long, in which the score is rough at the scale of a response surface. Its gradients scatter in every direction
# and predict a sigma of centimetres, which is too small. tz is therefore stepped through the valley, the other
# unknowns are solved again at each step, and a parabola gives the maximum and its sigma.
#
# Edges and markings are compared on the same path, because their biases differ (lane paint is uniform along its
# lane and blurs with distance). If both have independent errors of equal size, the error of the mean is half of
# their difference. If one of them hardly depends on tz, the other's bias is not known better than that.
#
# Sources: profile likelihood: Murphy & van der Vaart 2000; disagreement beyond the sigmas: Birge 1932.


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


# --------------------------------------------------------------------------------------------------
# The camera's time offset: the score's profile over it, with the log's focal length.
#
# Images of passed objects grow with the time offset as with focal length and with tz. Free together, the three
# drift along their valley: on simulated highways the focal length by 2 %, six of its sigmas, and the time
# offset by 20 to 30 ms. With the log's focal length and a fixed tz, edges determine the time offset to a few
# milliseconds. It is therefore stepped through its valley, the pose is solved again at each step, and the
# uncertainty of focal length and tz is added to its sigma.
#
# The profile uses edges that are in view at every possible offset (`Terms.seen_throughout`). With the others, a
# fisheye on a highway was 110 to 160 ms off, at a sigma of 10: four metres ahead, the rails at the side of the
# car came into view and matched, because rails match anywhere.
#
# Sources: profile likelihood: Murphy & van der Vaart 2000; parameters considered, not solved for: Schmidt 1966.


DT, FOCAL = 6, 7  # of the eight unknowns
_SLOW_MPS = 2.0  # below such speeds a shift along the axis is not made up for by the time offset
# Of an alarm: how far it looks [s], by how many edges, in steps of the way driven, and steps around each.
_FAR_S, _FAR_EDGES, _FAR_STEP_M, _FAR_LEAST_MPS, _FAR_AROUND, _FAR_KERNEL_PX = 1.0, 5000, 0.25, 4.0, 13, 2.5
_DT_AND_FOCAL = np.isin(np.arange(8), (DT, FOCAL))


@dataclass(frozen=True, eq=False)
class TimeOffsetProfile:
    """The best state of the profile, the variance of its time offset over resampled blocks, and its score."""

    state: AlignmentState
    variance_s2: float
    score: float
    ends: tuple[AlignmentState, ...] = ()  # the solved states, in order of their time offsets
    values: np.ndarray = field(default_factory=lambda: np.zeros(0))  # score of each of them
    scored: Scored | None = None  # by what they were solved


def s_per_metre(terms: Terms, state: AlignmentState) -> float:
    """Change of the time offset [s/m] that keeps static points at their pixels when the camera's tz grows by 1 m."""
    forward_mps = terms.velocity_lidar @ state.T_camera_lidar[2, :3]
    return float(forward_mps.sum() / (np.sum(forward_mps**2) + len(forward_mps) * _SLOW_MPS**2))


def profile_time_offset(
    scored: Scored, state: AlignmentState, fixed: Bool[np.ndarray, " 8"], block: Int[np.ndarray, " F"]
) -> TimeOffsetProfile:
    """Step the time offset to both sides of a solution while the score rises; solve the pose at each step.

    `fixed` are unknowns of the pose besides time offset and focal length; the focal length is the log's.
    `block` tells which frames have common errors.
    """
    speed_mps = float(np.sqrt(np.mean(np.sum(scored.terms.velocity_lidar**2, axis=1))))
    step_s = min(SCHEDULE.time_offset_step_m / max(speed_mps, 1.0), SCHEDULE.time_offset_max_step_s)
    ends = _ends(scored, state, step_s, fixed | _DT_AND_FOCAL)
    steps = np.array(sorted(ends))
    score = np.column_stack([ends[k][1] for k in steps])
    k = int(np.argmax(score.sum(0)))
    values = score.sum(0)
    top = maximum(values[None])[0]
    # Another sample of streets might have another of the valley's maxima.
    blocks = int(block.max()) + 1
    by_block = np.zeros((blocks, len(values)))
    np.add.at(by_block, block, score)
    drawn = np.random.default_rng(0).multinomial(
        blocks, np.full(blocks, 1 / blocks), size=SCHEDULE.time_offset_resamples
    )
    spread = float(np.mean((maximum(drawn @ by_block) - top) ** 2)) * blocks / max(blocks - 1, 1)
    best = replace(ends[int(steps[k])][0], dt_s=ends[0][0].dt_s + (top + steps[0]) * step_s)
    states = tuple(ends[k][0] for k in steps.tolist())
    return TimeOffsetProfile(best, spread * step_s**2, float(values[k]), states, values, scored)


def _ends(
    scored: Scored, state: AlignmentState, step_s: float, fixed: Bool[np.ndarray, " 8"]
) -> dict[int, tuple[AlignmentState, np.ndarray]]:
    """The solved state and each frame's score at time offsets on a grid, by number of steps from the start."""
    start = refine(scored, replace(state, focal=1.0), steps=SCHEDULE.profile_start_steps, fixed=fixed)
    ends = {0: (start, frame_scores(scored, start))}
    reach_s = SCHEDULE.time_offset_reach_s
    for sign in (1, -1):
        here = start
        for k in range(1, 2 * int(np.ceil(reach_s / step_s))):
            best = max(ends, key=lambda n: ends[n][1].sum())
            # Beyond the reach only as long as the best value is near.
            if k * step_s > reach_s and abs(sign * k - best) * step_s > reach_s / 2:
                break
            moved = replace(here, dt_s=start.dt_s + sign * k * step_s)
            here = refine(scored, moved, steps=SCHEDULE.profile_steps, fixed=fixed)
            ends[sign * k] = here, frame_scores(scored, here)
    return ends


def far_time_offset(
    terms: Terms, state: AlignmentState, kernel: KernelSettings, rng: np.random.Generator
) -> tuple[float, float]:
    """Time offset within a second at which edges match far better than around it [s], at any distance.

    Also returns its lead over the state's time offset in standard errors; 0 if both are equal.
    """
    some = terms.at_most(_FAR_EDGES, rng).of_kinds(edges=True, markings=False)
    speed_mps = float(np.sqrt(np.mean(np.sum(terms.velocity_lidar**2, axis=1))))
    step_s = _FAR_STEP_M / max(speed_mps, _FAR_LEAST_MPS)
    offsets = np.append(state.dt_s, np.arange(-_FAR_S, _FAR_S + step_s, step_s))
    order = np.argsort(offsets, kind="stable")
    T = np.repeat(state.T_camera_lidar[None], len(offsets), 0)
    at = Alignments(T, offsets[order], np.full(len(offsets), state.focal))
    score = some.score(at, replace(kernel, sigma_px=_FAR_KERNEL_PX)).astype(np.float64)
    peaks = np.empty_like(score)
    # On a slope nothing stands out: rails match wherever on them they are seen.
    peaks[order] = score - median_filter(score, size=(_FAR_AROUND, 1), mode="nearest")
    best = int(np.argmax(peaks.mean(1)))
    more = peaks[best] - peaks[0]
    return float(offsets[best]), float(more.mean() / (max(float(more.std()), 1e-12) / np.sqrt(len(more))))


def maximum(value: Float[np.ndarray, "S N"]) -> Float[np.ndarray, " S"]:
    """Maximum of each row, in steps: the top of the parabola through the highest value and its neighbours."""
    k = np.argmax(value, axis=1)
    inner = np.clip(k, 1, value.shape[1] - 2)
    before, at, after = (value[np.arange(len(value)), inner + d] for d in (-1, 0, 1))
    curvature = np.maximum(2 * at - before - after, 1e-9)
    return np.where(inner == k, k + 0.5 * (after - before) / curvature, k)


def compared_terms(scored: Scored) -> Terms:
    """What the time offset is told by: narrow edges; where there are none, wide ones; else markings.

    Markings run along the direction of travel and hardly determine the time: only their number in view
    depends on it. This slope moved three days of 16 rings 30 to 60 ms off, while edges were 1 to 12 ms off
    (tuning days 110 to 121: RMS 23 ms by both, 4.3 by edges).
    """
    terms = scored.terms
    if not len(terms.edges.xyz_m) or scored.kernel.edge_weight <= 0:
        return terms
    return terms.narrow if len(terms.narrow.edges.xyz_m) else terms.wide


def frame_scores(
    scored: Scored, state: AlignmentState, *, with_prior: bool = True
) -> Float[np.ndarray, " F"]:
    """Score of each frame, averaged over a ball because it is rough, and its share of the prior."""
    terms = compared_terms(scored)
    ball = DESIGN * np.where(_DT_AND_FOCAL, 0.0, scales(terms, scored.kernel))
    score = terms.score(state.changed(ball), scored.kernel).mean(0)
    prior = float(prior_value(state.alone, scored.prior, scored.config)[0]) if with_prior else 0.0
    return score + prior / len(score)


# --------------------------------------------------------------------------------------------------
# Bias of the camera's time offset: how far it moves, and the pose with it, without either half of the image.
#
# Other road users move between a lidar's point and the image, and edges on them are taken for static ones.
# Oncoming cars move the time offset one way, cars ahead the other, by up to the time between point and image. In
# a tunnel most edges lie on them: one time offset was 99 ms off at a sigma of 9. Rails and walls match anywhere
# along them and move it too. All frames share this error, so resampled frames do not show it. But oncoming traffic
# is on one half of the image, so the two halves disagree. Leaving out sides of objects or ranges as well did not
# fit the errors of 140 known days better. What moves both halves alike, such as cars ahead in all lanes, is not
# seen here.
#
# The changes are read off the profile, for the score is far from quadratic over decimetres of way.
#
# Source: jackknife over few clusters: MacKinnon, Nielsen, Webb 2023, https://doi.org/10.1002/jae.2969.


_SHARE = np.sqrt(1 - 1 / 2)  # of a jackknife over two clusters


def left_out_in_time(profile: TimeOffsetProfile, fixed: Bool[np.ndarray, " 8"]) -> Float[np.ndarray, "K 8"]:
    """Changes of the profile's best state without the right and without the left half of the image's edges.

    Args:
        profile: with its ends.
        fixed: unknowns that the solution has at the prior.

    Returns:
        A row per half, in coordinates of `AlignmentState.changed` [rad, m, s]: sigmas of the bias. None if one
        half has no edges.
    """
    if profile.scored is None or len(profile.ends) < 2:
        return np.zeros((0, 8))
    terms, middle = compared_terms(profile.scored), profile.ends[len(profile.ends) // 2]
    T = middle.T_camera_lidar
    is_right = terms.edges.xyz_m @ T[0, :3] + T[0, 3] > 0
    if is_right.all() or not is_right.any():
        return np.zeros((0, 8))
    changes = np.array([difference(end, middle) for end in profile.ends])
    changes[:, fixed & (np.arange(8) != DT)] = 0.0

    def at_best(values: np.ndarray) -> np.ndarray:
        step = float(maximum(values[None])[0])
        return np.array([np.interp(step, np.arange(len(changes)), column) for column in changes.T])

    best, rows = at_best(profile.values), []
    for half in (is_right, ~is_right):
        alone = replace(profile.scored, terms=replace(terms, edges=terms.edges.chosen(half)))
        own = np.array([frame_scores(alone, end, with_prior=False).sum() for end in profile.ends])
        rows.append(_SHARE * (at_best(profile.values - own) - best))
    return np.array(rows)

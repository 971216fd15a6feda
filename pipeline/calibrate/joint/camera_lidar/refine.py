"""Local refinement of the camera-lidar score: the unknowns as a state, annealed response surfaces that improve it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.numerics.covariance import DESIGN, at_least, fit_quadratics
from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.calibrate.numerics.nuisances import FOCAL_SIGMA, TYPICAL_RANGE_M, TYPICAL_SPEED_MPS
from pipeline.core.config import SolveConfig
from pipeline.core.sections import SearchRange
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_se3, exp_so3, from_rotation_translation, log_so3

__all__ = [
    "NONE_FIXED",
    "SCHEDULE",
    "AlignmentState",
    "Schedule",
    "Scored",
    "derivatives",
    "prior_value",
    "refine",
    "scales",
    "weighted",
]

_SURFACE_SIZE = 1.8  # radius of the response surface in kernel widths: the score is rough below one
_SHRINK = 0.75  # of that radius, after a step that stays within it
_SHRINK_AFTER_LOSS = 0.5  # likewise, after a step that would have lowered the score: its surface was too wide
_CONVERGED = 0.05  # a step of this share of the radius changes nothing that matters
_LEAST_PREDICTED = 0.5  # share of the curvature that the gradients' scatter predicts
_WEIGHTS = (0.002, 1.0)  # range of a term's weight
NONE_FIXED = np.zeros(8, bool)


@dataclass(frozen=True, eq=False)
class AlignmentState:
    """A pose, its time offset [s] and focal scale."""

    T_camera_lidar: np.ndarray
    dt_s: float = 0.0
    focal: float = 1.0

    def moved(self, xi: Float[np.ndarray, "P 8"]) -> Alignments:
        """Candidates at steps (left perturbation, dt, focal scale)."""
        return Alignments(
            exp_se3(xi[:, :6]) @ self.T_camera_lidar, self.dt_s + xi[:, 6], self.focal + xi[:, 7]
        )

    def changed(self, x: Float[np.ndarray, "P 8"]) -> Alignments:
        """Candidates at changes (rotation about the camera's axes, shift of the lidar's origin, dt, focal scale).

        These are the coordinates of the record: in them, a fixed unknown keeps its value when others move.
        """
        R = exp_so3(x[:, :3]) @ self.T_camera_lidar[:3, :3]
        T = from_rotation_translation(R, self.T_camera_lidar[:3, 3] + x[:, 3:6])
        return Alignments(T, self.dt_s + x[:, 6], self.focal + x[:, 7])

    def stepped(self, x: Float[np.ndarray, " 8"]) -> AlignmentState:
        """The state one change on."""
        at = self.changed(x[None])
        return AlignmentState(at.T_camera_lidar[0], float(at.dt_s[0]), float(at.focal[0]))

    def with_fixed(self, prior: Prior, fixed: Bool[np.ndarray, " 8"]) -> AlignmentState:
        """The state with the fixed degrees of freedom of its pose back at the prior."""
        turn = log_so3(self.T_camera_lidar[:3, :3] @ prior.T_camera_lidar[:3, :3].T)
        R = exp_so3(np.where(fixed[:3], 0.0, turn)) @ prior.T_camera_lidar[:3, :3]
        t = np.where(fixed[3:6], prior.T_camera_lidar[:3, 3], self.T_camera_lidar[:3, 3])
        return replace(self, T_camera_lidar=from_rotation_translation(R, t))

    def within(self, prior: Prior, limits: SearchRange) -> AlignmentState:
        """The nearest state whose turn and shift from the prior stay, per axis, within the search range."""
        turn = log_so3(self.T_camera_lidar[:3, :3] @ prior.T_camera_lidar[:3, :3].T)
        shift = self.T_camera_lidar[:3, 3] - prior.T_camera_lidar[:3, 3]
        if np.abs(turn).max() <= limits.rotation_rad and np.abs(shift).max() <= limits.translation_m:
            return self
        R = exp_so3(np.clip(turn, -limits.rotation_rad, limits.rotation_rad)) @ prior.T_camera_lidar[:3, :3]
        t = prior.T_camera_lidar[:3, 3] + np.clip(shift, -limits.translation_m, limits.translation_m)
        return replace(self, T_camera_lidar=from_rotation_translation(R, t))

    @property
    def alone(self) -> Alignments:
        """The state as one candidate."""
        return self.moved(np.zeros((1, 8)))


@dataclass(frozen=True, eq=False)
class Scored:
    """Objective of a refinement: the terms' score at a kernel plus the prior's log density.

    `limits` is the allowed range about the prior; None = no limit.
    """

    terms: Terms
    kernel: KernelSettings
    prior: Prior
    config: SolveConfig
    limits: SearchRange | None = None


def prior_value(at: Alignments, prior: Prior, config: SolveConfig) -> Float[np.ndarray, " P"]:
    """Log density of the prior, up to a constant."""
    turn = log_so3(at.T_camera_lidar[:, :3, :3] @ prior.T_camera_lidar[:3, :3].T) / prior.rotation_sigma_rad
    shift = (at.T_camera_lidar[:, :3, 3] - prior.T_camera_lidar[:3, 3]) / prior.translation_sigma_m
    others = (at.dt_s / config.time_offset_sigma_s) ** 2 + ((at.focal - 1) / FOCAL_SIGMA) ** 2
    return -0.5 * ((turn**2).sum(1) + (shift**2).sum(1) + others)


def scales(terms: Terms, kernel: KernelSettings) -> Float[np.ndarray, " 8"]:
    """Step per degree of freedom that moves typical points by about one kernel width."""
    angle = kernel.sigma_px / float(terms.camera[1])
    shift = angle * TYPICAL_RANGE_M
    return np.array([angle] * 3 + [shift] * 3 + [shift / TYPICAL_SPEED_MPS, FOCAL_SIGMA])


def refine(
    scored: Scored, state: AlignmentState, *, steps: int, fixed: Bool[np.ndarray, " 8"] = NONE_FIXED
) -> AlignmentState:
    """Maximise by Newton steps on response surfaces, for the score is rough at the scale of a pixel.

    Args:
        steps: maximum number of steps; valleys are long, because at high speed tz and the time offset are
            hardly separable.
        fixed: degrees of freedom that are fixed; those of the pose at the prior.
    """
    scale = _SURFACE_SIZE * scales(scored.terms, scored.kernel)
    free = np.flatnonzero(~fixed)
    state = state.with_fixed(scored.prior, fixed)
    value = _value(scored, state)
    for _ in range(steps):
        gradient, curvature = _surface(scored, state, scale)
        step = np.zeros(8)
        step[free] = np.linalg.solve(curvature[np.ix_(free, free)], gradient[free])
        length = float(np.linalg.norm(step))
        there = state.stepped(step / max(length, 1.0) * scale).with_fixed(scored.prior, fixed)
        if scored.limits is not None:
            there = there.within(scored.prior, scored.limits)
        value_there = _value(scored, there)
        if value_there < value:
            scale = scale * _SHRINK_AFTER_LOSS
            continue
        state, value = there, value_there
        if length < _CONVERGED:
            break
        if length < 1.0:
            scale = scale * _SHRINK
    return state


def _value(scored: Scored, state: AlignmentState) -> float:
    """Score and prior of a state."""
    at = state.alone
    score = float(scored.terms.score(at, scored.kernel).sum(dtype=np.float64))
    return score + float(prior_value(at, scored.prior, scored.config)[0])


def _surface(
    scored: Scored, state: AlignmentState, scale: Float[np.ndarray, " 8"]
) -> tuple[Float[np.ndarray, " 8"], Float[np.ndarray, "8 8"]]:
    """Gradient and curvature (positive definite) of score and prior over a ball of radius `scale`, in units of it.

    The curvature is at least half of the prediction from the scatter of the frames' gradients (Fisher
    scoring): in a direction that is flat or convex by roughness, a Newton step could end anywhere. The
    scatter is about the mean, because a nonzero mean is the remaining distance. When it was counted as
    curvature, steps were so short that time offsets stayed at their start.
    """
    at = state.changed(DESIGN * scale)
    gradient, H = fit_quadratics(scored.terms.score(at, scored.kernel))
    (prior_gradient,), (prior_H,) = fit_quadratics(prior_value(at, scored.prior, scored.config)[:, None])
    apart = gradient - gradient.mean(0)
    predicted = apart.T @ apart - prior_H
    least = _LEAST_PREDICTED * predicted + 1e-9 * np.trace(predicted) * np.eye(8)
    return gradient.sum(0) + prior_gradient, at_least(-H.sum(0) - prior_H, least)


def derivatives(
    terms: Terms, state: AlignmentState, kernel: KernelSettings, scale: Float[np.ndarray, " 8"]
) -> tuple[Float[np.ndarray, "F 8"], Float[np.ndarray, "F 8 8"]]:
    """Gradient and Hessian of each frame's score over a ball of radius `scale`, in units of `scale`."""
    return fit_quadratics(terms.score(state.changed(DESIGN * scale), kernel))


def weighted(terms: Terms, state: AlignmentState, kernel: KernelSettings, scenes: Scenes) -> KernelSettings:
    """Weight markings, narrow and wide edges so that the curvature of each equals its gradient's scatter over scenes.

    Errors of points of one frame are correlated (one mask boundary, one lane line), and so are those of
    frames of one scene. The curvature of a sum of log likelihood ratios is therefore too large, by another
    factor for each term.
    """
    scale = scales(terms, kernel)
    weights = []
    for part, edges in ((terms.narrow, 1.0), (terms.wide, 1.0), (terms, 0.0)):
        alone = replace(kernel, edge_weight=edges, marking_weight=1.0 - edges, wide_share=1.0)
        gradient, H = derivatives(part, state, alone, scale)
        scatter = scenes.scatter(gradient)
        curvature = -float(np.trace(H.sum(0)))
        weights.append(float(np.clip(curvature / scatter, *_WEIGHTS)) if scatter > 1e-9 else 0.0)
    narrow, wide, marking = weights
    share = wide / narrow if narrow else 1.0
    return replace(kernel, edge_weight=narrow or wide, marking_weight=marking, wide_share=share)


# --------------------------------------------------------------------------------------------------
# How camera-lidar is solved: kernel widths, steps and points of each stage, in one place.


@dataclass(frozen=True)
class Schedule:
    """Effort of each stage, in the order in which they run. Steps are local refinements, at most so many."""

    # Kernel width [label px] and contrast level, from wide to sharp.
    kernels: tuple[tuple[float, int], ...] = ((4.0, 0), (2.5, 1), (1.5, 2))

    # Basin: candidates of different origin climb at the first kernel above.
    wide_climb_steps: int = 4
    climb_steps: int = 6
    compared_points: int = 4000  # of each term, where ends are compared
    finishing_steps: int = 4  # of the best end, and of others that are no worse
    # Grid of rotations: kernel, step in kernels, points of each term, share of matching edges that it presumes.
    grid_kernel_deg: float = 0.6
    wide_grid_kernel_deg: float = 0.9  # beyond wide_box_deg
    wide_box_deg: float = 9.0
    grid_step_kernels: float = 1.5
    grid_points: int = 1500
    grid_frames: int = 24  # many points of few frames cost less than few points of many
    coarse_match: float = 0.1
    # How many of its poses by all terms together, and by each alone, are looked at with more points, and how many.
    grid_chosen: tuple[int, int] = (90, 20)
    chosen_points: int = 2000
    # Of its maxima so many are climbed, so far apart.
    grid_maxima: int = 4
    grid_apart_kernels: float = 3.0

    # Points of edges, and of markings: with wide kernels, with sharp ones, and for the time offset's profile, which is
    # sharp. More add nothing.
    wide_points: int = 8000
    sharp_points: int = 18000
    time_offset_points: int = 9000

    # Alignment.
    first_steps: int = 8
    sharper_steps: int = 4

    # Observability analysis: before and after the terms are weighted anew.
    steps_before_weights: int = 2
    steps_after_weights: int = 3

    # Profiles: steps of the other unknowns at each value of tz or time offset, and before the time offset's first.
    profile_steps: int = 1
    profile_start_steps: int = 2
    tz_values_per_side: int = 3
    tz_span_m: float = 0.36  # to each side
    time_offset_step_m: float = 0.2  # of way driven, ...
    time_offset_max_step_s: float = 0.012  # ... and at most
    time_offset_reach_s: float = 0.05
    time_offset_resamples: int = 200

    # Disjoint halves, from the solution of the whole.
    half_steps: int = 3
    # First and last part of the day, at each of two kernels.
    part_steps: int = 3


SCHEDULE = Schedule()

"""The camera-lidar score's ascent: a state of pose, clock and focal length, and annealed response surfaces up to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.numerics.response_surface import DESIGN, at_least, fit_quadratics
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.se3 import exp_se3, exp_so3, from_rotation_translation, log_so3
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms

__all__ = [
    "FOCAL_SIGMA",
    "NOTHING",
    "AlignmentState",
    "climb",
    "derivatives",
    "prior_value",
    "scales",
    "weighted",
]

# Typical distance of what edges and markings lie on: turns a width in pixels into metres.
_TYPICAL_RANGE_M = 12.0
_TYPICAL_SPEED_MPS = 8.0
# Intrinsics are known to about this; free within it, so that the pose along the optical axis is not surer
# than they are.
FOCAL_SIGMA = 0.003
_ARRIVED = 0.05  # a step of this share of the ball changes nothing that matters
NOTHING = np.zeros(8, bool)  # held


@dataclass(frozen=True, eq=False)
class AlignmentState:
    """A pose, its time offset and focal scale."""

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

        The chart of the record: what the day cannot determine must stay put in it, whatever else moves.
        """
        R = exp_so3(x[:, :3]) @ self.T_camera_lidar[:3, :3]
        T = from_rotation_translation(R, self.T_camera_lidar[:3, 3] + x[:, 3:6])
        return Alignments(T, self.dt_s + x[:, 6], self.focal + x[:, 7])

    def stepped(self, x: Float[np.ndarray, " 8"]) -> AlignmentState:
        """The state one change on."""
        at = self.changed(x[None])
        return AlignmentState(at.T_camera_lidar[0], float(at.dt_s[0]), float(at.focal[0]))

    def held(self, prior: Prior, held: Bool[np.ndarray, " 8"]) -> AlignmentState:
        """The state with some degrees of freedom of its pose back at the prior."""
        turn = log_so3(self.T_camera_lidar[:3, :3] @ prior.T_camera_lidar[:3, :3].T)
        R = exp_so3(np.where(held[:3], 0.0, turn)) @ prior.T_camera_lidar[:3, :3]
        t = np.where(held[3:6], prior.T_camera_lidar[:3, 3], self.T_camera_lidar[:3, 3])
        return replace(self, T_camera_lidar=from_rotation_translation(R, t))

    @property
    def alone(self) -> Alignments:
        """The state as one candidate."""
        return self.moved(np.zeros((1, 8)))


def prior_value(at: Alignments, prior: Prior, config: SolveConfig) -> Float[np.ndarray, " P"]:
    """Log density of the prior, up to a constant."""
    turn = log_so3(at.T_camera_lidar[:, :3, :3] @ prior.T_camera_lidar[:3, :3].T) / prior.rotation_sigma_rad
    shift = (at.T_camera_lidar[:, :3, 3] - prior.T_camera_lidar[:3, 3]) / prior.translation_sigma_m
    clock = (at.dt_s / config.time_offset_sigma_s) ** 2 + ((at.focal - 1) / FOCAL_SIGMA) ** 2
    return -0.5 * ((turn**2).sum(1) + (shift**2).sum(1) + clock)


def scales(terms: Terms, level: KernelSettings) -> Float[np.ndarray, " 8"]:
    """Step per DoF that moves typical points by about one kernel width."""
    angle = level.sigma_px / float(terms.camera[1])
    shift = angle * _TYPICAL_RANGE_M
    return np.array([angle] * 3 + [shift] * 3 + [shift / _TYPICAL_SPEED_MPS, FOCAL_SIGMA])


def climb(
    terms: Terms,
    state: AlignmentState,
    level: KernelSettings,
    prior: Prior,
    config: SolveConfig,
    *,
    steps: int,
    held: Bool[np.ndarray, " 8"] = NOTHING,
) -> AlignmentState:
    """Maximise by response surfaces: the score is rough at the scale of a pixel, and a quadratic over a ball is not.

    At most `steps`, for valleys are long: fast cars hardly tell tz from the clock.

    What is `held` stays at the prior.
    """
    scale = 1.8 * scales(terms, level)
    free = np.flatnonzero(~held)
    state = state.held(prior, held)
    for _ in range(steps):
        slope, curvature = _surface(terms, state, level, prior, config, scale)
        step = np.zeros(8)
        step[free] = np.linalg.solve(curvature[np.ix_(free, free)], slope[free])
        length = float(np.linalg.norm(step))
        state = state.stepped(step / max(length, 1.0) * scale).held(prior, held)
        if length < _ARRIVED:
            break
        if length < 1.0:
            scale = scale * 0.75
    return state


def _surface(
    terms: Terms,
    state: AlignmentState,
    level: KernelSettings,
    prior: Prior,
    config: SolveConfig,
    scale: Float[np.ndarray, " 8"],
) -> tuple[Float[np.ndarray, " 8"], Float[np.ndarray, "8 8"]]:
    """Slope and curvature (positive definite) of score and prior over a ball of `scale`, in units of it.

    At least half the curvature that the frames' gradients promise by their scatter (Fisher scoring): a direction
    that the roughness makes flat or convex would send a Newton step anywhere. About their mean: what frames agree on
    is way still to go, not curvature, and steps shortened by it left clocks where they began.
    """
    at = state.changed(DESIGN * scale)
    gradient, H = fit_quadratics(terms.score(at, level))
    (before,), (H_prior,) = fit_quadratics(prior_value(at, prior, config)[:, None])
    apart = gradient - gradient.mean(0)
    promised = apart.T @ apart - H_prior
    least = 0.5 * promised + 1e-9 * np.trace(promised) * np.eye(8)
    return gradient.sum(0) + before, at_least(-H.sum(0) - H_prior, least)


def derivatives(
    terms: Terms, state: AlignmentState, level: KernelSettings, scale: Float[np.ndarray, " 8"]
) -> tuple[Float[np.ndarray, "F 8"], Float[np.ndarray, "F 8 8"]]:
    """Gradient and Hessian of each frame's score over a ball of `scale`, in units of `scale`."""
    return fit_quadratics(terms.score(state.changed(DESIGN * scale), level))


def weighted(terms: Terms, state: AlignmentState, level: KernelSettings) -> KernelSettings:
    """Scale each term so that its curvature equals the scatter of its gradient over frames.

    Points of one frame err together (one mask boundary, one lane line), so a sum of log likelihood ratios
    promises too much, and by another factor for each term.
    """
    scale = scales(terms, level)
    weights = []
    for edges, markings in ((1.0, 0.0), (0.0, 1.0)):
        gradient, H = derivatives(
            terms, state, replace(level, edge_weight=edges, marking_weight=markings), scale
        )
        scatter = float(((gradient - gradient.mean(0)) ** 2).sum())
        curvature = -float(np.trace(H.sum(0)))
        weights.append(float(np.clip(curvature / scatter, 0.02, 1.0)) if scatter > 1e-9 else 0.0)
    return replace(level, edge_weight=weights[0], marking_weight=weights[1])

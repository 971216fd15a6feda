"""Camera-lidar half of method `joint`: T_camera_lidar and the camera's time offset from a day of observations.

A small differential evolution finds the basin (wide kernels, few points, restarts), annealed response
surfaces find the optimum, and the frames' own curvatures and gradients say how sure it is. Weights of the
terms come from the data: the share of matching edges, the contrast under markings, and how much a term's
gradient scatters from frame to frame against what its curvature promises (composite likelihood: Varin,
Reid, Firth 2011, section 2.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.config import SolveConfig
from pipeline.errors import SolveError
from pipeline.geometry.se3 import exp_se3, exp_so3, from_rotation_translation, inverse, log_so3
from pipeline.objective.camera_lidar_terms import Alignments, Level, Terms, lidar_velocities, prepare_terms
from pipeline.objective.problem import PairEstimate, Prior
from pipeline.solve.covariance import blocks_of, bootstrap_covariance, posterior, spread_to_covariance
from pipeline.solve.globalise import evolve
from schemas.observations import Observation

__all__ = ["AlignmentState", "camera_lidar_cost", "camera_lidar_information", "estimate_camera_lidar"]

_FEWEST_FRAMES = 5
_RESTARTS = 2
_COARSE_POINTS = 9000  # per restart: a basin needs no more
_FINE_POINTS = 24000  # of edges, and of markings; more say the same again
# Kernel widths [label px] and contrast levels, from wide to sharp.
_COARSE = Level.wide(10.0, 0, match=0.1)
# Nats per point of class information against log likelihood ratios: over the search box both then vary alike.
_CLASS_WEIGHT_PER_POINT = 0.12
_LADDER = ((4.0, 0), (2.5, 1), (1.5, 2))
_VERDICT = Level.wide(1.5, 2)
_MAX_GAP_PX = 5.0  # edges whose interval is wider (16 rings: 30 px) are for the basin only
# Typical distance of what edges and markings lie on: turns a width in pixels into metres.
_TYPICAL_RANGE_M = 12.0
_TYPICAL_SPEED_MPS = 8.0
# Intrinsics are known to about this; free within it, so that the pose along the optical axis is not surer
# than they are.
_FOCAL_SIGMA = 0.003
# What no resampling shows: mask dilation, focal length off by 0.1-0.5 %, rolling shutter
# (evidence/method.md, section 4).
# Along the optical axis more: lane lines pull tz (and with it dt) without resisting it, by 3-10 cm on real logs.
_BIAS_FLOOR = np.array([np.radians(0.03)] * 3 + [0.01, 0.01, 0.04])
_TIME_OFFSET_FLOOR_S = 0.004


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

    def stepped(self, xi: Float[np.ndarray, " 8"]) -> AlignmentState:
        """The state one step on."""
        return AlignmentState(
            exp_se3(xi[:6]) @ self.T_camera_lidar, self.dt_s + float(xi[6]), self.focal + float(xi[7])
        )

    @property
    def alone(self) -> Alignments:
        """The state as one candidate."""
        return self.moved(np.zeros((1, 8)))


def estimate_camera_lidar(
    observations: Sequence[Observation],
    prior: Prior,
    config: SolveConfig,
    rng: np.random.Generator,
    *,
    velocity_lidar: Float[np.ndarray, "F 3"] | None = None,
) -> PairEstimate:
    """Estimate T_camera_lidar and the camera's time offset.

    Args:
        observations: the day's frames; those with another camera or label size than the first are left out.
        prior: start, and weak information about pose; dt has prior 0 +- `time_offset_sigma_s`.
        config: search box and resampling.
        rng: decides everything random.
        velocity_lidar: own velocity per observation in lidar axes [m/s]; by default the speed along the
            heading that the radar's Doppler and the prior T_lidar_radar show.

    Raises:
        SolveError: too few frames, or nothing to align in them.
    """
    used, rejected = _usable(observations)
    if velocity_lidar is None:
        velocity_lidar = lidar_velocities(observations, prior.T_lidar_radar)
    if len(used) < _FEWEST_FRAMES:
        raise SolveError(f"camera-lidar needs {_FEWEST_FRAMES} frames of one camera, the day has {len(used)}")
    frames = [observations[i] for i in used]
    reach = np.radians(config.search_rotation_deg + 2.0)
    terms = prepare_terms(frames, prior.T_camera_lidar, velocity_lidar[used], reach_rad=float(reach))
    if len(terms.edges.xyz_m) < 20 * len(used):
        raise SolveError("camera-lidar: hardly any depth edges in the camera's field of view")

    starts = [_basin(terms, prior, config, rng) for _ in range(_RESTARTS)]
    sharp = terms.sharp(_MAX_GAP_PX).at_most(_FINE_POINTS, rng)
    thin = sharp.thinned(0.35, rng)
    first = Level.wide(*_LADDER[0])
    ends = [_climb(thin, s, first, prior, config, steps=5) for s in starts]
    scores = [float(sharp.score(e.alone, first).sum()) for e in ends]
    best = int(np.argmax(scores))
    state, level = ends[best], first
    for sigma_px, contrast in _LADDER[1:]:
        level = _weighted(sharp, state, sharp.fitted(state.alone, Level.wide(sigma_px, contrast), rng))
        state = _climb(sharp, state, level, prior, config, steps=5)
    halves = [
        _climb(sharp.of_frames(np.arange(k, len(used), 2)), state, level, prior, config, steps=4)
        for k in (0, 1)
    ]
    diagnostics = _diagnostics(sharp, level, state, ends, scores, halves)
    return _conclude(sharp, state, level, prior, config, rng, frames, rejected, diagnostics)


def camera_lidar_cost(
    observations: Sequence[Observation],
    T_camera_lidar: Float[np.ndarray, "4 4"],
    dt_s: float = 0.0,
    *,
    velocity_lidar: Float[np.ndarray, "F 3"] | None = None,
    T_lidar_radar: Float[np.ndarray, "4 4"] | None = None,
) -> Float[np.ndarray, " F"]:
    """Cost of each frame at a pose, for held-out verdicts: lower is better, sharp kernels, nothing fitted.

    Args:
        observations: frames of one camera.
        T_camera_lidar: the pose.
        dt_s: camera time offset, stamp_camera = stamp_lidar + dt.
        velocity_lidar: own velocity per frame in lidar axes; else from the observations and T_lidar_radar.
        T_lidar_radar: turns Doppler velocities into lidar axes; identity by default.
    """
    if velocity_lidar is None:
        velocity_lidar = lidar_velocities(observations, np.eye(4) if T_lidar_radar is None else T_lidar_radar)
    terms = prepare_terms(observations, T_camera_lidar, velocity_lidar, reach_rad=0.0).sharp(_MAX_GAP_PX)
    at = AlignmentState(T_camera_lidar, dt_s).alone
    return -(terms.edge_excess(at, _VERDICT) + terms.marking_score(at, _VERDICT))[0]


def camera_lidar_information(
    terms: Terms, T_camera_lidar: Float[np.ndarray, "4 4"], dt_s: float, level: Level | None = None
) -> tuple[Float[np.ndarray, " 7"], Float[np.ndarray, "7 7"]]:
    """Gradient of the COST (minus score) and information by (left perturbation, dt), for a joint solver.

    The focal scale is marginalised within its prior, so the translation along the optical axis says what it is worth.
    """
    gradient, information = terms.gradient(AlignmentState(T_camera_lidar, dt_s).alone, level or _VERDICT)
    g, I = -gradient.sum(0), information.sum(0)
    focal = I[7, 7] + _FOCAL_SIGMA**-2
    return g[:7] - I[:7, 7] * g[7] / focal, I[:7, :7] - np.outer(I[:7, 7], I[7, :7]) / focal


# -- steps -----------------------------------------------------------------------------------------------------------


def _usable(observations: Sequence[Observation]) -> tuple[list[int], dict[str, int]]:
    """Frames that share the first frame's camera and label size."""
    if not observations:
        return [], {}
    key = [
        (o.camera_model, o.camera_K.tobytes(), o.camera_D.tobytes(), o.image_width_px, o.label_scale)
        for o in observations
    ]
    used = [i for i, k in enumerate(key) if k == key[0]]
    others = len(observations) - len(used)
    return used, {"another camera": others} if others else {}


def _basin(terms: Terms, prior: Prior, config: SolveConfig, rng: np.random.Generator) -> AlignmentState:
    """Differential evolution in the search box, wide kernels, a random share of the points."""
    thin = terms.thinned(
        min(1.0, _COARSE_POINTS / max(len(terms.edges.xyz_m) + len(terms.markings.xyz_m), 1)), rng
    )
    weight = _CLASS_WEIGHT_PER_POINT * (len(thin.edges.xyz_m) + len(thin.markings.xyz_m))
    T_0 = prior.T_camera_lidar
    box = np.array([np.radians(config.search_rotation_deg)] * 3 + [config.search_translation_m] * 3)
    sigma = np.array([config.search_translation_m / 2] * 3)

    def poses(x: np.ndarray) -> np.ndarray:
        return from_rotation_translation(exp_so3(x[:, :3]) @ T_0[:3, :3], T_0[:3, 3] + x[:, 3:])

    def cost(x: np.ndarray) -> np.ndarray:
        at = Alignments.of_poses(poses(x))
        score = thin.score(at, _COARSE).sum(1) + weight * thin.class_information(at)
        return -score + 0.5 * ((x[:, 3:] / sigma) ** 2).sum(1)

    x, _ = evolve(cost, -box, box, rng, population=48, generations=36, start=np.zeros((1, 6)))
    return AlignmentState(poses(x[None])[0])


def _prior_value(at: Alignments, prior: Prior, config: SolveConfig) -> Float[np.ndarray, " P"]:
    """Log density of the prior, up to a constant."""
    turn = log_so3(at.T_camera_lidar[:, :3, :3] @ prior.T_camera_lidar[:3, :3].T) / prior.rotation_sigma_rad
    shift = (at.T_camera_lidar[:, :3, 3] - prior.T_camera_lidar[:3, 3]) / prior.translation_sigma_m
    clock = (at.dt_s / config.time_offset_sigma_s) ** 2 + ((at.focal - 1) / _FOCAL_SIGMA) ** 2
    return -0.5 * ((turn**2).sum(1) + (shift**2).sum(1) + clock)


def _scales(terms: Terms, level: Level) -> Float[np.ndarray, " 8"]:
    """Step per DoF that moves typical points by about one kernel width."""
    angle = level.sigma_px / float(terms.camera[1])
    shift = angle * _TYPICAL_RANGE_M
    return np.array([angle] * 3 + [shift] * 3 + [shift / _TYPICAL_SPEED_MPS, _FOCAL_SIGMA])


def _design() -> Float[np.ndarray, "P 8"]:
    """Points of the response surface: centre and antithetic pairs in a ball, the same for every call."""
    rng = np.random.default_rng(7)
    x = rng.normal(size=(66, 8))
    x *= (rng.random((66, 1)) ** (1 / 3)) / np.linalg.norm(x, axis=1, keepdims=True)
    return np.concatenate([np.zeros((1, 8)), x, -x])


_DESIGN = _design()
_UPPER = np.triu_indices(8)


_FIT = np.linalg.pinv(
    np.column_stack([np.ones(len(_DESIGN)), _DESIGN, _DESIGN[:, _UPPER[0]] * _DESIGN[:, _UPPER[1]]])
)


def _quadratic(
    value: Float[np.ndarray, "P F"],
) -> tuple[Float[np.ndarray, "F 8"], Float[np.ndarray, "F 8 8"]]:
    """Gradient and Hessian of the least-squares quadratic through each frame's values on the design."""
    c = (_FIT @ value).T
    H = np.zeros((value.shape[1], 8, 8))
    H[:, _UPPER[0], _UPPER[1]] = c[:, 9:]
    return c[:, 1:9], H + H.transpose(0, 2, 1)


def _climb(
    terms: Terms, state: AlignmentState, level: Level, prior: Prior, config: SolveConfig, *, steps: int
) -> AlignmentState:
    """Maximise by response surfaces: the score is rough at the scale of a pixel, and a quadratic over a ball is not.

    Newton steps, with at least half the curvature that the frames' gradients promise by their scatter
    (Fisher scoring): a direction that the roughness makes flat or convex would send the step anywhere.
    """
    scale = 1.8 * _scales(terms, level)
    for _ in range(steps):
        at = state.moved(_DESIGN * scale)
        gradient, H = _quadratic(terms.score(at, level))
        (before,), (H_prior,) = _quadratic(_prior_value(at, prior, config)[:, None])
        promised = gradient.T @ gradient - H_prior
        curvature = _at_least(-H.sum(0) - H_prior, 0.5 * promised + 1e-9 * np.trace(promised) * np.eye(8))
        step = np.linalg.solve(curvature, gradient.sum(0) + before)
        length = float(np.linalg.norm(step))
        state = state.stepped(step / max(length, 1.0) * scale)
        if length < 1.0:
            scale = scale * 0.75
    return state


def _at_least(
    curvature: Float[np.ndarray, "8 8"], least: Float[np.ndarray, "8 8"]
) -> Float[np.ndarray, "8 8"]:
    """The larger of two symmetric matrices in every direction; `least` must be positive definite."""
    return spread_to_covariance(0.5 * (curvature + curvature.T), least)


def _derivatives(
    terms: Terms, state: AlignmentState, level: Level, scale: Float[np.ndarray, " 8"]
) -> tuple[Float[np.ndarray, "F 8"], Float[np.ndarray, "F 8 8"]]:
    """Gradient and Hessian of each frame's score over a ball of `scale`, in units of `scale`."""
    return _quadratic(terms.score(state.moved(_DESIGN * scale), level))


def _weighted(terms: Terms, state: AlignmentState, level: Level) -> Level:
    """Scale each term so that its curvature equals the scatter of its gradient over frames.

    Points of one frame err together (one mask boundary, one lane line), so a sum of log likelihood ratios
    promises too much, and by another factor for each term.
    """
    scale = _scales(terms, level)
    weights = []
    for edges, markings in ((1.0, 0.0), (0.0, 1.0)):
        gradient, H = _derivatives(
            terms, state, replace(level, edge_weight=edges, marking_weight=markings), scale
        )
        scatter = float(((gradient - gradient.mean(0)) ** 2).sum())
        curvature = -float(np.trace(H.sum(0)))
        weights.append(float(np.clip(curvature / scatter, 0.02, 1.0)) if scatter > 1e-9 else 0.0)
    return replace(level, edge_weight=weights[0], marking_weight=weights[1])


def _diagnostics(
    terms: Terms,
    level: Level,
    state: AlignmentState,
    ends: list[AlignmentState],
    scores: list[float],
    halves: list[AlignmentState],
) -> dict[str, float]:
    """Numbers behind the verdict."""
    apart = _difference(halves[0], halves[1])
    spread = [_difference(e, ends[int(np.argmax(scores))]) for e in ends]
    return {
        "restart_rotation_spread_deg": max(float(np.degrees(np.linalg.norm(d[:3]))) for d in spread),
        "restart_translation_spread_m": max(float(np.linalg.norm(d[3:6])) for d in spread),
        "restart_score_spread": float(max(scores) - min(scores)),
        **{f"halves_{n}_deg": float(np.degrees(abs(apart[i]))) for i, n in enumerate(("rx", "ry", "rz"))},
        **{f"halves_{n}_m": float(abs(apart[3 + i])) for i, n in enumerate(("tx", "ty", "tz"))},
        "halves_dt_s": float(abs(apart[6])),
        **{
            f"edge_match_share_{n}": float(terms.mean_match(level)[i])
            for i, n in enumerate(("left", "right", "above", "below"))
        },
        "focal_scale": state.focal,
        "edge_weight": level.edge_weight,
        "marking_contrast_sd": level.delta,
        "marking_weight": level.marking_weight,
        "edges_per_frame": len(terms.edges.xyz_m) / terms.frames,
        "markings_per_frame": len(terms.markings.xyz_m) / terms.frames,
    }


def _difference(a: AlignmentState, b: AlignmentState) -> Float[np.ndarray, " 8"]:
    """Rotation vector, translation and dt from b to a."""
    D = a.T_camera_lidar @ inverse(b.T_camera_lidar)
    shift = a.T_camera_lidar[:3, 3] - b.T_camera_lidar[:3, 3]
    return np.concatenate([log_so3(D[:3, :3]), shift, [a.dt_s - b.dt_s, a.focal - b.focal]])


def _conclude(
    terms: Terms,
    state: AlignmentState,
    level: Level,
    prior: Prior,
    config: SolveConfig,
    rng: np.random.Generator,
    frames: list[Observation],
    rejected: dict[str, int],
    diagnostics: dict[str, float],
) -> PairEstimate:
    """Covariance from curvature and blocks, observability, notes."""
    scale = _scales(terms, level)
    gradient = _derivatives(terms, state, level, scale)[0] / scale
    prior_information = np.diag(
        [prior.rotation_sigma_rad**-2] * 3
        + [prior.translation_sigma_m**-2] * 3
        + [config.time_offset_sigma_s**-2, _FOCAL_SIGMA**-2]
    )
    # After `_weighted`, the scatter of the frames' gradients is the curvature, without its roughness
    # (Bartlett's identity).
    information = gradient[:, :, None] * gradient[:, None, :]
    block = blocks_of(np.array([o.drive for o in frames]), config.bootstrap_blocks)
    covariance = bootstrap_covariance(information, -gradient, prior_information, block, rng)
    after = posterior(covariance[:6, :6], prior.covariance("camera_lidar"), _BIAS_FLOOR)
    dt_sigma = float(np.sqrt(covariance[6, 6] + _TIME_OFFSET_FLOOR_S**2))
    notes = []
    if dt_sigma > 0.7 * config.time_offset_sigma_s:
        notes.append("camera time offset: the day's speeds do not determine it")
    return PairEstimate(
        "camera_lidar",
        state.T_camera_lidar,
        after.covariance,
        after.observability,
        after.observable,
        frames_used=len(frames),
        frames_rejected=rejected,
        time_offset_s=state.dt_s,
        time_offset_sigma_s=dt_sigma,
        diagnostics=diagnostics,
        notes=notes,
    )

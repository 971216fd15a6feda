"""Camera-lidar half of method `joint`: T_camera_lidar and the camera's time offset from a day of observations.

A small differential evolution finds the basin (wide kernels, few points, restarts), annealed response
surfaces find the optimum, and the frames' own curvatures and gradients say how sure it is. Weights of the
terms come from the data: the share of matching edges, the contrast under markings, and how much a term's
gradient scatters from frame to frame against what its curvature promises (composite likelihood: Varin,
Reid, Firth 2011, section 2.3). A degree of freedom that the day does not determine is then held at the prior and
the others solved again; their covariance includes what the prior leaves open in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.config import SolveConfig
from pipeline.errors import SolveError
from pipeline.geometry.changes import change_jacobian
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse, log_so3
from pipeline.objective.camera_lidar_terms import Alignments, Level, Terms, lidar_velocities, prepare_terms
from pipeline.objective.problem import PairEstimate, Prior
from pipeline.solve.camera_lidar_ascent import (
    FOCAL_SIGMA,
    NOTHING,
    AlignmentState,
    climb,
    derivatives,
    scales,
    weighted,
)
from pipeline.solve.covariance import OBSERVABLE, blocks_of, held_covariance, response
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
# What no resampling shows: mask dilation, focal length off by 0.1-0.5 %, rolling shutter
# (evidence/method.md, section 4).
_BIAS_FLOOR = np.array([np.radians(0.03)] * 3 + [0.01, 0.01, 0.01])
# Along the optical axis more: lane lines pull tz without resisting it, and dt and the others follow. Left to itself
# tz ends 3-25 cm (RMS 18) from the reference on halves of a real day, where resampling promises 2-4 cm.
_TZ, _TZ_BIAS_M = 5, 0.18
_TIME_OFFSET_FLOOR_S = 0.004


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
    terms = terms.of_kinds(edges="edges" in config.terms, markings="reflectivity" in config.terms)
    if "edges" in config.terms and len(terms.edges.xyz_m) < 20 * len(used):
        raise SolveError("camera-lidar: hardly any depth edges in the camera's field of view")

    starts = [_basin(terms, prior, config, rng) for _ in range(_RESTARTS)]
    sharp = terms.sharp(_MAX_GAP_PX).at_most(_FINE_POINTS, rng)
    thin = sharp.thinned(0.35, rng)
    first = Level.wide(*_LADDER[0])
    ends = [climb(thin, s, first, prior, config, steps=5) for s in starts]
    scores = [float(sharp.score(e.alone, first).sum()) for e in ends]
    best = int(np.argmax(scores))
    state, level = ends[best], first
    for sigma_px, contrast in _LADDER[1:]:
        level = weighted(sharp, state, sharp.fitted(state.alone, Level.wide(sigma_px, contrast), rng))
        state = climb(sharp, state, level, prior, config, steps=5)
    day = _Day(sharp, prior, config, [o.drive for o in frames], int(rng.integers(2**32)))
    found = _determined(day, state, level, rng)
    halves = [
        climb(
            sharp.of_frames(np.arange(k, len(used), 2)), found.state, found.level, prior, config,
            steps=4, held=found.held,
        )
        for k in (0, 1)
    ]  # fmt: skip
    diagnostics = _diagnostics(sharp, found.level, found.state, ends, scores, halves)
    return _conclude(found, config, len(frames), rejected, diagnostics)


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
    focal = I[7, 7] + FOCAL_SIGMA**-2
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


@dataclass(frozen=True, eq=False)
class _Day:
    """What every solution of one day shares."""

    terms: Terms
    prior: Prior
    config: SolveConfig
    drives: list[int]
    seed: int  # of the bootstrap: solutions compare on the same resampled days


@dataclass(frozen=True, eq=False)
class _Found:
    """A solution: what of it the day determined, and how surely (chart of `AlignmentState.changed`)."""

    state: AlignmentState
    level: Level
    held: np.ndarray  # 8, bool
    covariance: np.ndarray  # 8 8
    observability: np.ndarray  # 6


def _determined(day: _Day, state: AlignmentState, level: Level, rng: np.random.Generator) -> _Found:
    """Solve again with what the day cannot determine held at the prior, until nothing more is to be held.

    Left free, such a degree of freedom wanders as far as its prior lets it and drags others along: lane lines
    pull tz, and with it dt, by decimetres. To hold one can leave another undetermined, whose optimum follows it.
    """
    found = _measured(day, state, level, NOTHING, np.ones(6))
    while (
        held := found.held | np.append(found.observability < OBSERVABLE, [False, False])
    ).sum() > found.held.sum():
        state = climb(day.terms, found.state, level, day.prior, day.config, steps=2, held=held)
        level = weighted(day.terms, state, day.terms.fitted(state.alone, level, rng))
        state = climb(day.terms, state, level, day.prior, day.config, steps=4, held=held)
        found = _measured(day, state, level, held, found.observability)
    return found


def _measured(
    day: _Day,
    state: AlignmentState,
    level: Level,
    held: Bool[np.ndarray, " 8"],
    observability: Float[np.ndarray, " 6"],
) -> _Found:
    """Covariance of a solution; what is held has the prior's, and the others follow it (and the bias along tz)."""
    terms, prior = day.terms, day.prior
    scale = scales(terms, level)
    gradient = derivatives(terms, state, level, scale)[0] / scale
    prior_variance = np.array(
        [prior.rotation_sigma_rad**2] * 3
        + [prior.translation_sigma_m**2] * 3
        + [day.config.time_offset_sigma_s**2, FOCAL_SIGMA**2]
    )
    curvature = _smooth_curvature(terms, state, level) + np.diag(1 / prior_variance)
    # After `weighted`, the scatter of the frames' gradients is the curvature, without its roughness
    # (Bartlett's identity).
    information = gradient[:, :, None] * gradient[:, None, :]
    block = blocks_of(np.array(day.drives), day.config.bootstrap_blocks)
    covariance = held_covariance(
        information, -gradient, prior_variance, curvature, held, block, np.random.default_rng(day.seed)
    )
    floor = np.diag(np.where(held, 0.0, np.append(_BIAS_FLOOR, [_TIME_OFFSET_FLOOR_S, 0.0])) ** 2)
    if not held[_TZ]:
        along = response(curvature, np.arange(8) == _TZ, held)[:, 0] * _TZ_BIAS_M
        floor += np.outer(along, along)
    covariance = covariance + floor
    shrunk = np.clip(1 - np.diag(covariance) / prior_variance, 0.0, 1.0)[:6]
    return _Found(state, level, held, covariance, np.where(held[:6], observability, shrunk))


def _smooth_curvature(terms: Terms, state: AlignmentState, level: Level) -> Float[np.ndarray, "8 8"]:
    """Curvature of the cost without its roughness, in the chart of `changed`: Gauss-Newton, from the points' slopes.

    For ratios only. Moving tz on real logs moves dt by -0.04 s/m: this says -0.03, response surfaces +0.1 to -0.1.
    """
    _, information = terms.gradient(state.alone, level)
    to_left = np.eye(8)
    to_left[:6, :6] = np.linalg.inv(change_jacobian(state.T_camera_lidar))
    return to_left.T @ information.sum(0) @ to_left


def _conclude(
    found: _Found,
    config: SolveConfig,
    frames: int,
    rejected: dict[str, int],
    diagnostics: dict[str, float],
) -> PairEstimate:
    """The estimate, its covariance by left perturbation, notes."""
    dt_sigma = float(np.sqrt(found.covariance[6, 6]))
    notes = []
    if dt_sigma > 0.7 * config.time_offset_sigma_s:
        notes.append("camera time offset: the day's speeds do not determine it")
    to_left = np.linalg.inv(change_jacobian(found.state.T_camera_lidar))
    return PairEstimate(
        "camera_lidar",
        found.state.T_camera_lidar,
        to_left @ found.covariance[:6, :6] @ to_left.T,
        found.observability,
        ~found.held[:6],
        frames_used=frames,
        frames_rejected=rejected,
        time_offset_s=found.state.dt_s,
        time_offset_sigma_s=dt_sigma,
        diagnostics=diagnostics,
        notes=notes,
    )

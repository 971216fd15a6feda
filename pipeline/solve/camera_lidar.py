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
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.config import SolveConfig
from pipeline.errors import SolveError
from pipeline.geometry.changes import change_jacobian
from pipeline.objective.camera_lidar_terms import Level, Terms, lidar_velocities, prepare_terms
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
from pipeline.solve.camera_lidar_motion import motion_biases, sweep_s_per_rad
from pipeline.solve.camera_lidar_profile import TZ, Profile, profile_tz, with_tz
from pipeline.solve.camera_lidar_search import Basin, difference, find_basin
from pipeline.solve.covariance import OBSERVABLE, blocks_of, held_covariance, response
from pipeline.solve.search_range import search_range
from schemas.observations import Observation

__all__ = ["AlignmentState", "camera_lidar_cost", "camera_lidar_information", "estimate_camera_lidar"]

_FEWEST_FRAMES = 5
_THIN_POINTS, _FINE_POINTS = 8000, 18000  # of edges, and of markings; more say the same again
_MARGIN_RAD = np.radians(2.0)  # points further out of view than this stay out of it
# Kernel widths [label px] and contrast levels, from wide to sharp.
_LADDER = ((4.0, 0), (2.5, 1), (1.5, 2))
_VERDICT = Level.wide(1.5, 2)
_MAX_GAP_PX = 5.0  # edges whose interval is wider (16 rings: 30 px) are for the basin only
# What no resampling shows: mask dilation, focal length off by 0.1-0.5 %, rolling shutter
# (evidence/method.md, section 4).
_BIAS_FLOOR = np.array([np.radians(0.03)] * 3 + [0.01, 0.01, 0.01])
_NEAR_PRIOR_M = 0.25
_HEADING_SIGMA_RAD = np.radians(0.3)  # of velocities that a caller knows
_IS_TZ = np.arange(8) == TZ
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
    heading_sigma = _HEADING_SIGMA_RAD
    if velocity_lidar is None:
        velocity_lidar = lidar_velocities(observations, prior.T_lidar_radar)
        heading_sigma = float(np.hypot(heading_sigma, prior.rotation_sigma_rad))
    if len(used) < _FEWEST_FRAMES:
        raise SolveError(f"camera-lidar needs {_FEWEST_FRAMES} frames of one camera, the day has {len(used)}")
    frames = [observations[i] for i in used]
    reach = search_range(prior, config)[0] + _MARGIN_RAD
    terms = prepare_terms(frames, prior.T_camera_lidar, velocity_lidar[used], reach_rad=reach)
    terms = terms.of_kinds(edges="edges" in config.terms, markings="reflectivity" in config.terms)
    if "edges" in config.terms and len(terms.edges.xyz_m) < 20 * len(used):
        raise SolveError("camera-lidar: hardly any depth edges in the camera's field of view")

    first = Level.wide(*_LADDER[0])
    sharp = terms.sharp(_MAX_GAP_PX)
    thin = sharp.at_most(_THIN_POINTS, rng)
    basin = find_basin(terms, thin, first, prior, config, rng)
    sharp = sharp.in_view(basin.state.T_camera_lidar, _MARGIN_RAD).at_most(_FINE_POINTS, rng)
    # Wide kernels are biased along the optical axis: where the prior is better than that, enter the valley there.
    near = prior.translation_sigma_m <= _NEAR_PRIOR_M
    held = _IS_TZ if near else NOTHING
    state = replace(basin.state, dt_s=0.0) if near else basin.state
    state = climb(thin, state, first, prior, config, steps=8, held=held)
    for sigma_px, contrast in _LADDER[1:]:
        level = weighted(sharp, state, sharp.fitted(state.alone, Level.wide(sigma_px, contrast), rng))
        state = climb(sharp, state, level, prior, config, steps=5, held=held)
    day = _Day(
        sharp,
        prior,
        config,
        [o.drive for o in frames],
        int(rng.integers(2**32)),
        prior.translation_sigma_m**2,
        heading_sigma,
        sweep_s_per_rad(frames),
    )
    found = _determined(day, state, level, rng)
    halves = [
        climb(
            sharp.of_frames(np.arange(k, len(used), 2)), found.state, found.level, found.prior, config,
            steps=3, held=found.held,
        )
        for k in (0, 1)
    ]  # fmt: skip
    diagnostics = _diagnostics(sharp, found, basin, halves)
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


def _diagnostics(
    terms: Terms,
    found: _Found,
    basin: Basin,
    halves: list[AlignmentState],
) -> dict[str, float]:
    """Numbers behind the verdict."""
    apart = difference(halves[0], halves[1])
    level, profile = found.level, found.profile
    return {
        "restarts": float(basin.restarts),
        "restart_rotation_spread_deg": float(np.degrees(basin.rotation_spread_rad)),
        "restart_translation_spread_m": basin.translation_spread_m,
        "restart_score_spread": basin.score_spread,
        **{f"halves_{n}_deg": float(np.degrees(abs(apart[i]))) for i, n in enumerate(("rx", "ry", "rz"))},
        **{f"halves_{n}_m": float(abs(apart[3 + i])) for i, n in enumerate(("tx", "ty", "tz"))},
        "halves_dt_s": float(abs(apart[6])),
        **{
            f"edge_match_share_{n}": float(terms.mean_match(level)[i])
            for i, n in enumerate(("left", "right", "above", "below"))
        },
        "tz_bias_m": profile.bias_m,
        "tz_kinds_apart_m": profile.kinds_apart_m,
        "tz_kinds_sigma_m": profile.kinds_sigma_m,
        "focal_scale": found.state.focal,
        "edge_weight": level.edge_weight,
        "marking_contrast_sd": level.delta,
        "marking_weight": level.marking_weight,
        "edges_per_frame": len(terms.edges.xyz_m) / terms.frames,
        "markings_per_frame": len(terms.markings.xyz_m) / terms.frames,
    }


@dataclass(frozen=True, eq=False)
class _Day:
    """What every solution of one day shares."""

    terms: Terms
    prior: Prior
    config: SolveConfig
    drives: list[int]
    seed: int  # of the bootstrap: solutions compare on the same resampled days
    tz_variance: float  # [m2]
    heading_sigma_rad: float
    sweep_s_per_rad: float
    clock_bias_s: float = 0.0


@dataclass(frozen=True, eq=False)
class _Found:
    """A solution: what of it the day determined, and how surely (chart of `AlignmentState.changed`)."""

    prior: Prior  # with the tz that was found
    state: AlignmentState
    level: Level
    held: np.ndarray  # 8, bool
    covariance: np.ndarray  # 8 8
    observability: np.ndarray  # 6
    profile: Profile


def _determined(day: _Day, state: AlignmentState, level: Level, rng: np.random.Generator) -> _Found:
    """Fix tz by its profile, then solve again with what the day cannot determine held at the prior.

    Left free, such a degree of freedom wanders as far as its prior lets it and drags others along: lane lines
    pull tz, and with it dt, by decimetres. To hold one can leave another undetermined, whose optimum follows it.
    """
    follow = response(_curvature(day, state, level), _IS_TZ, NOTHING)[:, 0]
    profile = profile_tz(day.terms, state, level, day.prior, day.config, follow)
    before = float(day.prior.T_camera_lidar[2, 3]), day.prior.translation_sigma_m
    tz_m, variance = profile.with_prior(*before)
    seen = 1 - variance / before[1] ** 2
    if seen < OBSERVABLE:
        tz_m, variance = before[0], before[1] ** 2
    # Seen from a moving car, a shift of the evidence along the axis is one in time.
    speed_mps = max(float(np.sqrt(np.mean(day.terms.velocity_lidar**2) * 3)), 1.0)
    clock_bias_s = profile.bias_m / speed_mps
    day = replace(day, prior=with_tz(day.prior, tz_m), tz_variance=variance, clock_bias_s=clock_bias_s)
    state = state.stepped(follow * (tz_m - state.T_camera_lidar[2, 3]))
    held, observability = _IS_TZ, np.ones(6)
    while True:
        state = climb(day.terms, state, level, day.prior, day.config, steps=2, held=held)
        level = weighted(day.terms, state, day.terms.fitted(state.alone, level, rng))
        state = climb(day.terms, state, level, day.prior, day.config, steps=4, held=held)
        covariance, shrunk = _measured(day, state, level, held)
        observability = np.where(held[:6], observability, shrunk)
        held_too = held | np.append(observability < OBSERVABLE, [False, False])
        if held_too.sum() == held.sum():
            break
        held = held_too
    observability[TZ] = max(seen, 0.0)
    return _Found(day.prior, state, level, held, covariance, observability, profile)


def _measured(
    day: _Day, state: AlignmentState, level: Level, held: Bool[np.ndarray, " 8"]
) -> tuple[Float[np.ndarray, "8 8"], Float[np.ndarray, " 6"]]:
    """Covariance of a solution and observability; what is held has its own variance, and the others follow it."""
    terms, prior_variance = day.terms, _prior_variance(day)
    scale, curvature = scales(terms, level), _curvature(day, state, level)
    gradient = derivatives(terms, state, level, scale)[0] / scale
    # After `weighted`, the scatter of the frames' gradients is the curvature, without its roughness
    # (Bartlett's identity).
    information = gradient[:, :, None] * gradient[:, None, :]
    block = blocks_of(np.array(day.drives), day.config.bootstrap_blocks)
    covariance = held_covariance(
        information,
        -gradient,
        prior_variance,
        curvature,
        held,
        block,
        np.random.default_rng(day.seed),
    )
    clock_floor_s = np.hypot(_TIME_OFFSET_FLOOR_S, day.clock_bias_s)
    floor = np.where(held, 0.0, np.append(_BIAS_FLOOR, [clock_floor_s, 0.0]))
    motion = motion_biases(terms, state, level, curvature, held, day.heading_sigma_rad, day.sweep_s_per_rad)
    covariance = covariance + np.diag(floor**2) + motion.T @ motion
    return covariance, np.clip(1 - np.diag(covariance) / prior_variance, 0.0, 1.0)[:6]


def _prior_variance(day: _Day) -> Float[np.ndarray, " 8"]:
    """Of every unknown before the frames' gradients are asked: of tz what its profile left."""
    rotation, translation = day.prior.rotation_sigma_rad, day.prior.translation_sigma_m
    sigma = np.array([rotation] * 3 + [translation] * 3 + [day.config.time_offset_sigma_s, FOCAL_SIGMA])
    return np.where(_IS_TZ, day.tz_variance, sigma**2)


def _curvature(day: _Day, state: AlignmentState, level: Level) -> Float[np.ndarray, "8 8"]:
    """Curvature of the cost without its roughness, in the chart of `changed`: Gauss-Newton, from the points' slopes.

    For ratios only. Moving tz on real logs moves dt by -0.04 s/m: this says -0.03, response surfaces +0.1 to -0.1.
    """
    _, information = day.terms.gradient(state.alone, level)
    to_left = np.eye(8)
    to_left[:6, :6] = np.linalg.inv(change_jacobian(state.T_camera_lidar))
    return to_left.T @ information.sum(0) @ to_left + np.diag(1 / _prior_variance(day))


def _conclude(
    found: _Found,
    config: SolveConfig,
    frames: int,
    rejected: dict[str, int],
    diagnostics: dict[str, float],
) -> PairEstimate:
    """The estimate, its covariance by left perturbation, notes."""
    dt_sigma = float(np.sqrt(found.covariance[6, 6]))
    notes = [f"focal length free within {FOCAL_SIGMA:.1%} of the log's: {found.state.focal - 1:+.2%}"]
    if dt_sigma > 0.7 * config.time_offset_sigma_s:
        notes.append("camera time offset: the day's speeds do not determine it")
    to_left = np.linalg.inv(change_jacobian(found.state.T_camera_lidar))
    return PairEstimate(
        "camera_lidar",
        found.state.T_camera_lidar,
        to_left @ found.covariance[:6, :6] @ to_left.T,
        found.observability,
        found.observability >= OBSERVABLE,
        frames_used=frames,
        frames_rejected=rejected,
        time_offset_s=found.state.dt_s,
        time_offset_sigma_s=dt_sigma,
        diagnostics=diagnostics,
        notes=notes,
    )

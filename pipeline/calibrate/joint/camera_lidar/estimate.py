"""Camera-lidar half of method `joint`: T_camera_lidar and the camera's time offset from a day of observations.

Candidates of several origins are optimised until one leads (`initialise`). Annealed response surfaces find
the optimum, and the frames' own curvatures and gradients give its covariance. Weights of the terms come from
the data: the share of matching edges, the contrast under markings, and the scatter of a term's gradient from
frame to frame compared with its curvature (composite likelihood: Varin, Reid, Firth 2011, section 2.3). A
degree of freedom that the day does not determine is then fixed at the prior, and the others are solved again;
their covariance includes its prior uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from pipeline.calibrate.joint.camera_lidar.initialise import (
    MARGIN_RAD,
    Basin,
    difference,
    find_basin,
    settled,
)
from pipeline.calibrate.joint.camera_lidar.intrinsics import DayIntrinsics, measure_intrinsics
from pipeline.calibrate.joint.camera_lidar.observability import (
    IS_TZ,
    CameraLidarProblem,
    ObservabilityAnalysis,
    analyse_observability,
    parts_of_alignment,
)
from pipeline.calibrate.joint.camera_lidar.part_turns import disagreement, turn_numbers, turns_by_parts
from pipeline.calibrate.joint.camera_lidar.profiles import DT, FOCAL, TZ, far_time_offset, s_per_metre
from pipeline.calibrate.joint.camera_lidar.refine import (
    NONE_FIXED,
    SCHEDULE,
    AlignmentState,
    Scored,
    refine,
    weighted,
)
from pipeline.calibrate.joint.camera_lidar.rotation_search import TERMS as BASIN_TERMS
from pipeline.calibrate.numerics.covariance import OBSERVABLE
from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.calibrate.numerics.nuisances import (
    TZ_COMMON_BIAS_M,
    Considered,
    PartTurn,
    considered_numbers,
    estimate_biases,
)
from pipeline.calibrate.reasons import because
from pipeline.core.config import SolveConfig
from pipeline.core.errors import SolveError
from pipeline.objective.camera_lidar.image_maps import Start
from pipeline.objective.camera_lidar.label_width import label_width_px, widened
from pipeline.objective.camera_lidar.points import lidar_velocities
from pipeline.objective.camera_lidar.score import KernelSettings, Terms, prepare_terms
from pipeline.objective.stamp_gaps import expected_dt_s, gaps_s
from pipeline.rig.estimates import PairEstimate, Prior, common_part
from pipeline.rig.se3 import change_jacobian
from schemas.observations import Observation

__all__ = ["Aligned", "AlignmentState", "align_camera_lidar", "analyse_camera_lidar"]

_FEWEST_FRAMES = 5
_FEWEST_EDGES = 20  # per frame
_NEAR_PRIOR_M = 0.25
_UNKNOWN_SHARE = 0.7  # of the prior's sigma: from there on the day's speeds did not determine the time offset


@dataclass(frozen=True, eq=False)
class Aligned:
    """An alignment accurate to a tenth of a degree, from which `analyse_camera_lidar` continues."""

    problem: CameraLidarProblem
    frames: list[Observation]
    rejected: dict[str, int]
    basin: Basin
    state: AlignmentState
    kernel: KernelSettings
    expected_dt_s: float  # the state's time offset counts from it (`stamp_gaps.expected_dt_s`)
    intrinsics: DayIntrinsics
    label_width_px: (
        float  # by which labels are wider than their objects, and the problem's edges moved outward
    )


def align_camera_lidar(
    observations: Sequence[Observation], prior: Prior, config: SolveConfig, rng: np.random.Generator
) -> Aligned:
    """Find the basin and refine in it, from wide to narrow kernels.

    The car drives along the heading that the radar's Doppler and the prior T_lidar_radar show.

    Args:
        observations: the day's frames; those with another camera or label size than the first are left out.
        prior: start, and weak information about pose; dt is expected to be the constant part of the stamps'
            gaps, with `time_offset_sigma_s`, or 0 with the camera's `stamp_sigma_s`.
        config: search box and resampling.
        rng: source of all random numbers.

    Raises:
        SolveError: too few frames, or nothing to align in them.
    """
    used, rejected = _usable(observations)
    if (stated_s := prior.camera.stamp_sigma_s) is not None:
        config = config.model_copy(update={"time_offset_sigma_s": stated_s})
    heading_rad = None if prior.heading is None else prior.heading[0]
    velocity_lidar = lidar_velocities(observations, prior.T_lidar_radar, heading_rad)
    if len(used) < _FEWEST_FRAMES:
        raise SolveError(because("few of a camera", needed=_FEWEST_FRAMES, used=len(used)))
    frames = [observations[i] for i in used]
    terms = _terms(frames, velocity_lidar[used], prior, config)
    terms = terms.exposed_at(AlignmentState(prior.T_camera_lidar).alone)

    first = KernelSettings.wide(*SCHEDULE.kernels[0])
    sharp = terms.telling()
    limits = config.search_range(prior.sigmas)
    thin = Scored(sharp.at_most(SCHEDULE.wide_points, rng), first, prior, config, limits)
    scenes = Scenes.of(frames, config.bootstrap_blocks)
    basin = find_basin(terms, thin, rng, scenes.block)
    thin = replace(thin, terms=thin.terms.exposed_at(basin.state.alone), kernel=basin.kernel)
    sharp = sharp.in_view(basin.state.T_camera_lidar, MARGIN_RAD).at_most(SCHEDULE.sharp_points, rng)
    sharp, kernel, basin, state = _refined(thin, sharp, terms, basin, scenes, rng)
    width_px = label_width_px(sharp, state.alone, kernel)
    sharp, seed = widened(sharp, state.T_camera_lidar, width_px), int(rng.integers(2**32))
    problem = CameraLidarProblem(sharp, prior, config, scenes, seed, prior.translation_sigma_m**2)
    intrinsics = measure_intrinsics(problem, state, kernel, frames, rng)
    dt_s = expected_dt_s(gaps_s(frames, "camera"), stated_s)
    return Aligned(problem, frames, rejected, basin, state, kernel, dt_s, intrinsics, width_px)


def _refined(
    thin: Scored, sharp: Terms, terms: Terms, basin: Basin, scenes: Scenes, rng: np.random.Generator
) -> tuple[Terms, KernelSettings, Basin, AlignmentState]:
    """The basin's best end, and its rival, from the wide kernel to the narrowest: where the best one led."""
    # Wide kernels are biased along the optical axis: where the prior is better than that, start at its tz.
    near = thin.prior.translation_sigma_m <= _NEAR_PRIOR_M
    fixed = IS_TZ if near else NONE_FIXED
    starts = {"best": basin.state, "rival": basin.rival}
    ends = {name: start for name, start in starts.items() if start is not None}
    ends = {k: _at_prior_tz(end, thin.prior, terms) if near else end for k, end in ends.items()}
    ends = {k: refine(thin, end, steps=SCHEDULE.first_steps, fixed=fixed) for k, end in ends.items()}
    scored = replace(thin, terms=sharp)
    for sigma_px, contrast in SCHEDULE.kernels[1:]:
        sharp = sharp.exposed_at(ends["best"].alone)
        fitted = sharp.fitted(ends["best"].alone, KernelSettings.wide(sigma_px, contrast), rng)
        scored = replace(thin, terms=sharp, kernel=weighted(sharp, ends["best"], fitted, scenes))
        ends = {k: refine(scored, end, steps=SCHEDULE.sharper_steps, fixed=fixed) for k, end in ends.items()}
    state = ends["best"]
    if (rival := ends.get("rival")) is not None:
        basin = settled(basin, scored, state, rival)
    return sharp, scored.kernel, basin, state


def analyse_camera_lidar(
    aligned: Aligned, rng: np.random.Generator, *, heading_rad: float | None = None
) -> PairEstimate:
    """The estimate with tz, time offset, observability and covariance.

    Args:
        aligned: the start.
        rng: for the chance densities and the points of the time offset's profile.
        heading_rad: azimuth of the direction of travel in lidar axes; by default the velocities are those of
            `aligned`.
    """
    problem = aligned.problem
    if heading_rad is not None:
        velocity = lidar_velocities(aligned.frames, problem.prior.T_lidar_radar, heading_rad)
        problem = replace(problem, terms=problem.terms.exposed_at(aligned.state.alone, velocity))
    analysis = analyse_observability(problem, aligned.state, aligned.kernel, rng)
    fixed = analysis.fixed | (np.arange(8) == FOCAL)
    scored = Scored(problem.terms, analysis.kernel, analysis.prior, problem.config)
    diagnostics = _diagnostics(problem.terms, analysis, aligned.basin)
    own_tz = analysis.profile.shift_from(float(problem.prior.T_camera_lidar[2, 3]))
    own_dt_s, z = far_time_offset(problem.terms, analysis.state, analysis.kernel, rng)
    diagnostics |= {
        "label_width_px": aligned.label_width_px,
        **considered_numbers(analysis.considered, of_camera=True),
        "left_out_dt_s": float(np.linalg.norm(analysis.considered[-1].rows[:, DT])),
    }
    diagnostics |= {"own_dt_s": aligned.expected_dt_s + own_dt_s, "own_dt_z": z}
    diagnostics |= _moved_by_labels(scored, analysis.state, fixed)
    if analysis.observability[5] < OBSERVABLE and own_tz is not None:
        diagnostics |= {"own_tz_m": own_tz[0], "own_tz_sigma_m": own_tz[1]}
    own = np.sqrt(np.diag(analysis.covariance)[:2]).tolist()
    at, block = (analysis.state, analysis.kernel), problem.scenes.block
    turns = turns_by_parts(aligned.frames, problem.terms, *at, block, problem.seed, own)
    parts = parts_of_alignment(problem, analysis, aligned.frames)
    return replace(_conclude(analysis, aligned, diagnostics, turns), parts=parts)


# -- steps -----------------------------------------------------------------------------------------------------------


def _terms(
    frames: Sequence[Observation], velocity_lidar: np.ndarray, prior: Prior, config: SolveConfig
) -> Terms:
    """The terms selected in the config, with all points that can come into view within the search range."""
    reach, T = config.search_range(prior.sigmas).rotation_rad + MARGIN_RAD, prior.T_camera_lidar
    readout_s, start = prior.camera.readout_s, Start(T, prior.rotation_sigma_rad)
    terms = prepare_terms(frames, T, velocity_lidar, reach_rad=reach, readout_s=readout_s, start=start)
    dt_s = expected_dt_s(terms.gap_s, prior.camera.stamp_sigma_s)
    terms = replace(terms, gap_s=terms.gap_s - dt_s)  # so that the time offset is beyond it
    terms = terms.of_kinds(edges="edges" in config.terms, markings="reflectivity" in config.terms)
    if "edges" in config.terms and len(terms.edges.xyz_m) < _FEWEST_EDGES * len(frames):
        raise SolveError(because("few edges"))
    return terms


def _usable(observations: Sequence[Observation]) -> tuple[list[int], dict[str, int]]:
    """Frames that share the first frame's camera and label size, and whose own speed is known where most are.

    Without the speed, the distance driven between sweep and image is unknown. When such frames were treated
    as standing, 10 frames of 32 on a simulated highway moved the time offset by 30 ms.
    """
    if not observations:
        return [], {}
    key = [
        (o.camera_model, o.camera_K.tobytes(), o.camera_D.tobytes(), o.image_width_px, o.label_scale)
        for o in observations
    ]
    used = [i for i, k in enumerate(key) if k == key[0]]
    moving = [i for i in used if observations[i].ego_speed_mps is not None]
    known = moving if 2 * len(moving) >= len(used) else used
    rejected = {"another camera": len(observations) - len(used), "own speed unknown": len(used) - len(known)}
    return known, {reason: count for reason, count in rejected.items() if count}


def _at_prior_tz(state: AlignmentState, prior: Prior, terms: Terms) -> AlignmentState:
    """Reset tz to the prior; adjust dt so that static points keep their pixels."""
    shift_m = float(state.T_camera_lidar[2, 3] - prior.T_camera_lidar[2, 3])
    return replace(state, dt_s=state.dt_s + s_per_metre(terms, state) * shift_m).with_fixed(prior, IS_TZ)


def _moved_by_labels(
    scored: Scored, state: AlignmentState, fixed: Bool[np.ndarray, " 8"]
) -> dict[str, float]:
    """Rotation from the solution with labels beside their picture to that with labels moved back [deg]."""
    if not any(scored.terms.label_offset_px):
        return {}
    beside = replace(scored, terms=replace(scored.terms, label_offset_px=(0.0, 0.0)))
    turned = difference(state, refine(beside, state, steps=SCHEDULE.half_steps, fixed=fixed))[:3]
    names = ("pitch", "yaw", "roll")
    return {f"labels_moved_{n}_deg": float(np.degrees(v)) for n, v in zip(names, turned, strict=True)}


def _diagnostics(terms: Terms, analysis: ObservabilityAnalysis, basin: Basin) -> dict[str, float]:
    """Numbers behind the verdict."""
    kernel, profile = analysis.kernel, analysis.profile
    return {
        "candidates": float(basin.candidates),
        **{f"basin_{name}": value for name, value in zip(BASIN_TERMS, basin.evidence, strict=True)},
        "basin_needed": basin.needed,
        "basin_rival_deg": float(np.degrees(basin.rival_rad)),
        "basin_rival_z": float(min(basin.rival_z, 1e3)),
        **{
            f"edge_match_share_{n}": float(terms.mean_match(kernel)[i])
            for i, n in enumerate(("left", "right", "above", "below"))
        },
        "tz_bias_m": profile.bias_m,
        "tz_kinds_apart_m": profile.kinds_apart_m,
        "tz_kinds_sigma_m": profile.kinds_sigma_m,
        "focal_scale": analysis.state.focal,
        "edge_weight": kernel.edge_weight,
        "marking_contrast_sd": kernel.delta,
        "marking_weight": kernel.marking_weight,
        "edges_per_frame": len(terms.edges.xyz_m) / terms.frames,
        "markings_per_frame": len(terms.markings.xyz_m) / terms.frames,
    }


def _conclude(
    analysis: ObservabilityAnalysis,
    aligned: Aligned,
    diagnostics: dict[str, float],
    turns: Sequence[PartTurn],
) -> PairEstimate:
    """The estimate, its covariance by left perturbation, notes."""
    dt_sigma = float(np.sqrt(analysis.covariance[DT, DT]))
    expected_sigma = aligned.problem.config.time_offset_sigma_s
    # The profile took all errors for independent, and gave the expected time offset too little weight. The pose stays:
    # solved at the weighted time offset, it was worse on known days.
    dt_weight = 1 - (dt_sigma / expected_sigma) ** 2
    known = analysis.prior.camera
    notes = aligned.intrinsics.notes(known)
    if known.stamp_sigma_s is None and dt_sigma > _UNKNOWN_SHARE * expected_sigma:
        notes.append(because("camera clock"))
    to_left = np.linalg.inv(change_jacobian(analysis.state.T_camera_lidar))
    covariance = to_left @ analysis.covariance[:6, :6] @ to_left.T
    return PairEstimate(
        "camera_lidar",
        analysis.state.T_camera_lidar,
        covariance,
        analysis.observability,
        analysis.observability >= OBSERVABLE,
        frames_used=len(aligned.frames),
        frames_rejected=aligned.rejected,
        time_offset_s=aligned.expected_dt_s + dt_weight * analysis.state.dt_s,
        time_offset_sigma_s=dt_sigma,
        diagnostics=diagnostics | aligned.intrinsics.diagnostics(known) | turn_numbers(turns),
        notes=notes,
        common_covariance=common_part(to_left @ analysis.common[:6, :6] @ to_left.T, covariance),
        failed_checks=disagreement(turns),
        time_offset_prior_s=aligned.expected_dt_s,
        **estimate_biases([*analysis.considered, _tz_bias(analysis)], to_left),
    )


def _tz_bias(analysis: ObservabilityAnalysis) -> Considered:
    """Common errors of edges and markings in tz, with the weight of its profile against the prior."""
    weight = max(float(analysis.observability[TZ]), 0.0)
    sigma_m = float(np.hypot(analysis.profile.bias_m, TZ_COMMON_BIAS_M)) if weight >= OBSERVABLE else 0.0
    return Considered("optical_axis", weight * sigma_m * np.eye(6)[[TZ]], in_weights=True)

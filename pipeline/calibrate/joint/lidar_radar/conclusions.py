"""Conclusions about a lidar-radar solution other than the pose: the radar's own position, numbers, notes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int64

from pipeline.calibrate.joint.lidar_radar.elevation_errors import contradiction, own_numbers
from pipeline.calibrate.joint.lidar_radar.observability import ObservabilityAnalysis, with_measured_curvature
from pipeline.calibrate.joint.lidar_radar.problem import DT, RANGE, RadarProblem, RadarState
from pipeline.calibrate.joint.lidar_radar.search import comparison_cost, finish
from pipeline.calibrate.numerics.bias_floors import RADAR_ELEVATION_BIAS_RAD, RANGE_BIAS_SIGMA_M
from pipeline.calibrate.numerics.covariance import bootstrap_covariance
from pipeline.calibrate.numerics.nuisances import considered_numbers
from pipeline.rig.changes import change_between

__all__ = ["diagnostics_of", "notes_of", "own_position"]

# --------------------------------------------------------------------------------------------------
# Horizontal position of the radar from the day alone, without its prior; for an alarm, not an estimate.
#
# While a car drives, x has the same effect on detections as the time offset, so a day of few speeds leaves x at
# the prior. A prior half a metre wrong is then hidden: the time offset compensates it by .05 s, and azimuths
# change by .2 deg. But frames of other speeds contradict this. So x, y and the time offset are solved again
# without the prior of position.
#
# This alone would raise false alarms. If the car keeps one speed, the three unknowns move along their valley,
# by .8 m on a simulated motorway, because the cost has a slope along the direction of travel that is unrelated
# to time. A true optimum is a dip: the frames align better there than at the prior, and better than at the same
# distance beyond.


_ANYWHERE_M = 1.0  # sigma of the position where its prior is left out
_GROUND = {3: "x", 4: "y"}  # of the pose's six


def own_position(
    problem: RadarProblem,
    state: RadarState,
    fixed: Bool[np.ndarray, " P"],
    block: Int64[np.ndarray, " F"],
) -> dict[str, float]:
    """Shift from the prior along each ground axis that was fixed, its sigma, and its significance.

    Returns by name `own_tx_m`, `own_tx_sigma_m` (or ty), and the normal deviates by which frames align better
    there than at the prior (`own_z_prior`) and as far beyond (`own_z_beyond`); empty if the day determined
    both axes.
    """
    asked = [k for k in _GROUND if fixed[k]]
    if not asked:
        return {}
    free = fixed & ~np.isin(np.arange(len(fixed)), [*asked, DT])
    anywhere = replace(problem, prior=replace(problem.prior, translation_sigma_m=_ANYWHERE_M))
    there, linear = finish(anywhere, state, free)
    use = ~free
    information = with_measured_curvature(anywhere, there, linear.information)[:, use][:, :, use]
    covariance = bootstrap_covariance(
        information,
        linear.g[:, use],
        linear.prior_information[np.ix_(use, use)],
        block,
        np.random.default_rng(0),
    )
    sigma = np.zeros(len(fixed))
    sigma[use] = np.sqrt(np.diag(covariance))
    shift = change_between(problem.prior.T_lidar_radar, there.T_lidar_radar)
    found = {f"own_t{_GROUND[k]}_m": float(shift[k]) for k in asked}
    found |= {f"own_t{_GROUND[k]}_sigma_m": float(sigma[k]) for k in asked}
    beyond = problem.prior.T_lidar_radar.copy()
    beyond[:3, 3] += 2 * np.where(np.isin(np.arange(3, 6), asked), shift[3:6], 0.0)
    mirrored = replace(problem, prior=replace(problem.prior, T_lidar_radar=beyond))
    others = {"prior": state, "beyond": finish(mirrored, there, fixed)[0]}
    block = block[problem.frames.frame]
    own = comparison_cost(problem, there)
    return found | {f"own_z_{n}": _z(own - comparison_cost(problem, s), block) for n, s in others.items()}


def _z(difference: Float[np.ndarray, " F"], block: Int64[np.ndarray, " F"]) -> float:
    """Normal deviate of a mean that is 0 where neither is better; negative = lower."""
    sums = np.bincount(block, difference)
    return float(sums.sum() / max(float(np.sqrt(np.sum(sums**2))), 1e-12))


# --------------------------------------------------------------------------------------------------
# Conclusions about a lidar-radar solution other than the pose: its data, its assumptions, numbers for checks.


_DT_UNSURE_S = 0.005  # a time offset known no better than this gets a note
_NAMES = np.array(["roll", "pitch", "yaw", "x", "y", "z"])


def notes_of(analysis: ObservabilityAnalysis) -> list[str]:
    """Notes on undetermined unknowns and on assumptions."""
    fixed, heights = analysis.fixed, analysis.problem.heights
    notes = []
    if fixed[:6].any():
        notes.append(f"not determined by this day, kept at the prior: {', '.join(_NAMES[fixed[:6]])}")
    dt_sigma_s = float(np.sqrt(analysis.covariance[DT, DT]))
    if fixed[DT]:
        notes.append("time offset: not determined by this day; the constant gap of its stamps is kept")
    elif dt_sigma_s > _DT_UNSURE_S:
        notes.append(
            f"time offset known to {1e3 * dt_sigma_s:.0f} ms only: at constant speed a shift in x has the same effect"
        )
    notes.append("vehicle boxes are not used: roll and pitch depend on the registration and the prior")
    if _travel_frames(analysis):
        notes.append(
            "radar pitch assumes that the car drives parallel to the road that the lidar sees under it"
        )
    if heights is not None:
        notes.append(
            f"{heights.displaced:.0%} of the detections of low objects lie between the object and its mirror "
            f"image in the road; radar pitch allows for them, with a sigma of "
            f"{np.degrees(heights.floor_rad):.2f} deg"
        )
    disagreement = contradiction(analysis.sources)
    if disagreement is not None:
        notes.append(disagreement.sentence)
    bias_sigma_m = float(np.sqrt(analysis.covariance[RANGE, RANGE]))
    if analysis.problem.frames.has_elevation.any():
        own_deg = float(np.degrees(RADAR_ELEVATION_BIAS_RAD))
        notes.append(
            "pitch is the direction of the radar's detections: its mounting differs by the radar's own constant"
            f" elevation error (0 +- {own_deg:.2f} deg)"
        )
    else:
        notes.append(
            "the radar measures no elevation: azimuth and range only, roll and pitch are the prior's"
        )
    notes += [
        f"range bias {analysis.state.range_bias_m:+.3f} +- {bias_sigma_m:.3f} m (prior 0 +- {RANGE_BIAS_SIGMA_M:.2f})",
    ]
    return notes


def diagnostics_of(analysis: ObservabilityAnalysis) -> dict[str, float]:
    """Numbers of a solution; non-finite values are left out."""
    state, linear, heights = analysis.state, analysis.linear, analysis.problem.heights
    diagnostics = {
        "azimuth_sigma_rad": float(state.sigma[0]),
        "elevation_sigma_rad": float(state.sigma[1]),
        "range_sigma_m": float(state.sigma[2]),
        "range_bias_m": state.range_bias_m,
        "range_bias_sigma_m": float(np.sqrt(analysis.covariance[RANGE, RANGE])),
        "bounce_share": state.bounce,
        **({} if heights is None else {"displaced_share": heights.displaced}),
        "assigned_share": float(linear.registration.assigned.mean()),
        "moving_azimuth_sigma_rad": linear.mover_sigma_rad,
        **own_numbers(analysis.sources),
        **considered_numbers(analysis.considered, of_camera=False),
        "doppler_frames": float(_travel_frames(analysis)),
        "doppler_scatter_rad": linear.travel_scatter_rad,
    }  # fmt: skip
    return {k: v for k, v in diagnostics.items() if np.isfinite(v)}


def _travel_frames(analysis: ObservabilityAnalysis) -> int:
    """Number of frames by whose direction of travel pitch is known."""
    travel = analysis.problem.travel
    is_asked = any(source.name == "doppler" for source in analysis.sources)
    return travel.count if travel is not None and is_asked else 0

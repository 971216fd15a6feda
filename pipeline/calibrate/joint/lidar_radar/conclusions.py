"""Conclusions about a lidar-radar solution other than the pose: the radar's own position, numbers, notes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int64

from pipeline.calibrate.joint.lidar_radar.elevation_errors import contradiction, own_numbers, radar_tilt_axes
from pipeline.calibrate.joint.lidar_radar.observability import ObservabilityAnalysis, with_measured_curvature
from pipeline.calibrate.joint.lidar_radar.problem import DT, RANGE, RadarProblem, RadarState
from pipeline.calibrate.joint.lidar_radar.search import comparison_cost, finish
from pipeline.calibrate.numerics.bias_floors import RADAR_ELEVATION_BIAS_RAD, RANGE_BIAS_SIGMA_M
from pipeline.calibrate.numerics.covariance import bootstrap_covariance
from pipeline.rig.changes import change_between
from pipeline.rig.checks import Check, change_of
from pipeline.rig.estimates import PairEstimate

__all__ = ["diagnostics_of", "lidar_radar_failures", "notes_of", "own_position"]

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
_SIGMAS = 3.0
# Restarts end before the last steps: only another basin counts, and only in certified axes.
_RESTART_ROTATION_RAD, _RESTART_SHIFT_M = np.radians(0.15), 0.05
_HALVES_FACTOR = 2  # two halves differ by twice the error of the whole, if their errors are independent
_DOF_UNITS = ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")


def notes_of(analysis: ObservabilityAnalysis, *, has_elevation: bool) -> list[str]:
    """Notes on undetermined unknowns and on assumptions."""
    fixed, linear = analysis.fixed, analysis.linear
    notes = []
    if fixed[:6].any():
        notes.append(f"not determined by this day, kept at the prior: {', '.join(_NAMES[fixed[:6]])}")
    dt_sigma_s = float(np.sqrt(analysis.covariance[DT, DT]))
    if fixed[DT]:
        notes.append("time offset not determined by this day, kept at what its stamps' constant gap suggests")
    elif dt_sigma_s > _DT_UNSURE_S:
        notes.append(
            f"time offset known to {1e3 * dt_sigma_s:.0f} ms only: where the car keeps one speed, x looks the same"
        )
    notes.append("vehicle boxes are not used: roll and pitch depend on the registration and the prior")
    if linear.travel_frames:
        notes.append(
            "radar pitch assumes that the car drives along its road, as the lidar sees it under the car"
        )
    if analysis.heights is not None:
        notes.append(
            f"radar pitch allows for detections between things and their mirror images in the road: a share of "
            f"{analysis.heights.displaced:.2f} of those of low things, which this day tells no better than to "
            f"{np.degrees(analysis.heights.floor_rad):.2f} deg of pitch"
        )
    disagreement = contradiction(analysis.sources)
    if disagreement is not None:
        notes.append(disagreement.sentence)
    bias_sigma_m = float(np.sqrt(analysis.covariance[RANGE, RANGE]))
    if has_elevation:
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


def diagnostics_of(
    analysis: ObservabilityAnalysis, ends: list[RadarState], halves: list[RadarState]
) -> dict[str, float]:
    """Numbers of a solution, of the ends of its starts and of the day's halves; non-finite values are left out."""
    state, linear = analysis.state, analysis.linear
    half = change_between(halves[1].T_lidar_radar, halves[0].T_lidar_radar)
    apart = change_between(ends[-1].T_lidar_radar, ends[0].T_lidar_radar)
    diagnostics = {
        "azimuth_sigma_rad": float(state.sigma[0]),
        "elevation_sigma_rad": float(state.sigma[1]),
        "range_sigma_m": float(state.sigma[2]),
        "range_bias_m": state.range_bias_m,
        "range_bias_sigma_m": float(np.sqrt(analysis.covariance[RANGE, RANGE])),
        "bounce_share": state.bounce,
        **({} if analysis.heights is None else {"displaced_share": analysis.heights.displaced}),
        "assigned_share": float(linear.registration.assigned.mean()),
        "moving_azimuth_sigma_rad": linear.mover_sigma_rad,
        "registration_roll_offset_rad": float(linear.registration_step[0]),
        "registration_roll_sigma_rad": float(linear.floor[0]),
        "registration_pitch_offset_rad": float(linear.registration_step[1]),
        "registration_pitch_sigma_rad": float(linear.floor[1]),
        **own_numbers(analysis.sources),
        "doppler_frames": float(linear.travel_frames),
        "doppler_scatter_rad": linear.travel_scatter_rad,
        **{f"halves_{n}": float(v) for n, v in zip(_DOF_UNITS, half, strict=True)},
        "halves_dt_s": halves[0].dt_s - halves[1].dt_s,
        "restarts_rz_rad": float(apart[2]),
        "restarts_tx_m": float(apart[3]),
        "restarts_ty_m": float(apart[4]),
    }  # fmt: skip
    return {k: v for k, v in diagnostics.items() if np.isfinite(v)}


def lidar_radar_failures(estimate: PairEstimate) -> list[Check]:
    """Restarts, halves, and the registration against the camera's boxes."""
    if not estimate.diagnostics:
        return []
    failed = [_restarts(estimate), _halves(estimate), *_registration(estimate)]
    return [check for check in failed if check is not None]


def _restarts(estimate: PairEstimate) -> Check | None:
    """Ends of the search in different basins: if another one is right, the pose is off by all of their distance."""
    least = np.array([np.inf, np.inf, _RESTART_ROTATION_RAD, _RESTART_SHIFT_M, _RESTART_SHIFT_M, np.inf])
    apart = _known(estimate, "restarts")
    return _difference("restarts", apart, np.maximum(least, _SIGMAS * _sigma(estimate)), apart)


def _halves(estimate: PairEstimate) -> Check | None:
    """The pose lies between those of the halves."""
    apart = _known(estimate, "halves")
    return _difference("disjoint halves", apart, _SIGMAS * _HALVES_FACTOR * _sigma(estimate), apart / 2)


def _difference(
    who: str, apart: Float[np.ndarray, " 6"], allowed: Float[np.ndarray, " 6"], error: Float[np.ndarray, " 6"]
) -> Check | None:
    beyond = np.flatnonzero(np.abs(apart) > allowed)
    if not len(beyond):
        return None
    sizes = " and ".join(f"{_NAMES[k]} by {_size(k, float(apart[k]))}" for k in beyond.tolist())
    return Check(f"{who} disagree in {sizes}", "witnesses_disagree", error=change_of(error))


def _registration(estimate: PairEstimate) -> list[Check]:
    """What turns the radar's roll or pitch if the registration alone is right."""
    d, failed = estimate.diagnostics, []
    for axis, name in zip(radar_tilt_axes(estimate.T).T, ("roll", "pitch"), strict=True):
        offset, floor = d[f"registration_{name}_offset_rad"], d[f"registration_{name}_sigma_rad"]
        known = estimate.observable[int(np.argmax(np.abs(axis)))]
        own = float(np.sqrt(axis @ estimate.covariance[:2, :2] @ axis))
        if known and abs(offset) > _SIGMAS * np.hypot(floor, own):
            turned = f"would turn {name} by {np.degrees(offset):+.1f} deg, camera and prior would not"
            error = change_of([*(axis * offset), 0.0, 0.0, 0.0, 0.0])
            failed.append(Check(f"the registration {turned}", "witnesses_disagree", error=error))
    return failed


def _known(estimate: PairEstimate, of: str) -> Float[np.ndarray, " 6"]:
    """A change in the diagnostics, 0 where it is not there or the day did not determine it."""
    change = np.array([estimate.diagnostics.get(f"{of}_{key}", 0.0) for key in _DOF_UNITS])
    return np.where(estimate.observable, change, 0.0)


def _sigma(estimate: PairEstimate) -> Float[np.ndarray, " 6"]:
    return np.sqrt(np.diag(estimate.covariance))


def _size(k: int, value: float) -> str:
    return f"{np.degrees(value):+.2f} deg" if k < 3 else f"{value:+.3f} m"

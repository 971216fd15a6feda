"""Conclusions about a lidar-radar solution other than the pose: its data, its assumptions, numbers for checks."""

from __future__ import annotations

import numpy as np

from pipeline.calibrate.joint.lidar_radar.observability import ObservabilityAnalysis
from pipeline.calibrate.joint.lidar_radar.pitch_sources import contradiction, own_numbers
from pipeline.calibrate.joint.lidar_radar.problem import DT, RANGE, RadarState
from pipeline.calibrate.numerics.bias_floors import RADAR_ELEVATION_BIAS_RAD, RANGE_BIAS_SIGMA_M
from pipeline.rig.changes import change_between

__all__ = ["diagnostics_of", "notes_of"]

_DT_UNSURE_S = 0.005  # a time offset known no better than this gets a note
_NAMES = np.array(["roll", "pitch", "yaw", "x", "y", "z"])
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

"""What a study asks of one calibration record against known truth, and of many of them together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import change_between, change_covariance
from pipeline.rig.targets import errors_at_targets
from pipeline.store.current import targets_of, transform_of
from schemas.calibrations import CalibrationRecord

__all__ = ["LIMITS_DEG", "inside_share", "measure", "mounting_error", "rms", "within"]

# The limits for an accepted result, and the axes of the parent frame that turn azimuth and elevation.
LIMITS_DEG = {"camera_lidar": 0.2, "camera_radar": 0.4, "lidar_radar": 0.4}
ELEVATION_LIMITS_DEG = {"camera_lidar": 0.2, "camera_radar": 0.6, "lidar_radar": 0.6}
AZIMUTH_ELEVATION_DOF = {"camera_lidar": (1, 0), "camera_radar": (1, 0), "lidar_radar": (2, 1)}


def measure(
    record: CalibrationRecord, T_true: Float[np.ndarray, "4 4"], prior: Prior, dt_true_s: float | None
) -> dict[str, Any]:
    """One record against truth, small enough for a line of JSON.

    `error` is the change (rotation vector about the child, its position; parent axes, rad and m) from truth to the
    result and `sigma` what the record's covariance says of it; `*_deg`, `range_m` are the paper's errors at its three
    targets; `prior_*` the same for the prior.
    """
    pair = record.pair
    T_prior = prior.of(pair)
    azimuth, elevation, range_m = errors_at_targets(pair, T_prior, T_true, targets_of(record))
    out: dict[str, Any] = {
        "status": record.status,
        "reason": record.reason,
        "prior_error": _rounded(change_between(T_true, T_prior)),
        "prior_az_deg": _number(np.degrees(azimuth)),
        "prior_el_deg": _number(np.degrees(elevation)),
        "prior_range_m": _number(range_m),
        "frames_used": record.frames_used,
    }
    T = transform_of(record)
    if T is None or record.covariance is None:
        return out
    azimuth, elevation, range_m = errors_at_targets(pair, T, T_true, targets_of(record))
    out |= {
        "az_deg": _number(np.degrees(azimuth)),
        "el_deg": _number(np.degrees(elevation)),
        "range_m": _number(range_m),
        "error": _rounded(change_between(T_true, T)),
        "sigma": _rounded(np.sqrt(np.diag(change_covariance(T, record.covariance)))),
        "observable": [int(v) for v in record.observable or []],
        "loop_rotation_rad": None if record.loop_rotation_rad is None else _number(record.loop_rotation_rad),
        "diagnostics": {k: _number(v) for k, v in sorted(record.diagnostics.items())},
    }
    if record.time_offset_s is not None:
        out |= {
            "dt_s": _number(record.time_offset_s),
            "dt_sigma_s": None if record.time_offset_sigma_s is None else _number(record.time_offset_sigma_s),
            "dt_true_s": None if dt_true_s is None else _number(dt_true_s),
        }
    return out


def mounting_error(record: CalibrationRecord, T_mounted: Float[np.ndarray, "4 4"]) -> dict[str, float]:
    """Elevation error at the targets against the mounting itself, a radar's own constant error included."""
    T = transform_of(record)
    if T is None or not record.pair.endswith("radar"):
        return {}
    return {"mounting_el_deg": _number(np.degrees(errors_at_targets(record.pair, T, T_mounted)[1]))}


def within(pair: str, measured: Mapping[str, Any], *, claimed: bool = False) -> bool:
    """Azimuth and elevation at the targets are within the limit.

    Args:
        pair: camera_lidar, camera_radar or lidar_radar.
        measured: what `measure` returned.
        claimed: ask only of angles that the record vouches for (`diagnostics["vouched_az"]`, `vouched_el`); where it
            does not say, of those whose axis it calls determined by the day.
    """
    azimuth, elevation = _claimed_angles(pair, measured, claimed=claimed)
    return azimuth <= LIMITS_DEG[pair] and elevation <= ELEVATION_LIMITS_DEG[pair]


def _claimed_angles(pair: str, measured: Mapping[str, Any], *, claimed: bool) -> tuple[float, float]:
    """Azimuth and elevation error [deg]; 0 for what is not claimed."""
    angles = [float(measured["az_deg"]), float(measured["el_deg"])]
    if claimed:
        flags = [
            measured.get("diagnostics", {}).get(f"vouched_{name}", measured["observable"][k])
            for name, k in zip(("az", "el"), AZIMUTH_ELEVATION_DOF[pair], strict=True)
        ]
        angles = [a if flag else 0.0 for a, flag in zip(angles, flags, strict=True)]
    return angles[0], angles[1]


def inside_share(errors: Float[np.ndarray, " N"], sigmas: Float[np.ndarray, " N"], count: float) -> float:
    """Share of errors inside `count` sigmas; NaN of none."""
    return float(np.mean(np.abs(errors) <= count * sigmas)) if len(errors) else float("nan")


def rms(values: Sequence[float] | Float[np.ndarray, " N"]) -> float:
    """Root mean square; NaN of none."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _rounded(values: np.ndarray) -> list[float]:
    return [_number(v) for v in values]


def _number(value: float) -> float:
    """Five digits: study files are committed, and nobody reads more."""
    return float(f"{float(value):.5g}")

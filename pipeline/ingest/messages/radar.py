"""Radar scans as PointCloud2, RadarScan or RadarTracks; Doppler becomes range rate, positive = receding."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from pipeline.core.rigs import RadarTopics
from pipeline.ingest.messages.point_cloud import cloud_columns, first_field, unit_that_fits, within

__all__ = ["CORRECT_FIELD", "RadarCloud", "read_radar"]

CORRECT_FIELD = "correct the field in fleet.toml"  # end of a reason that no other log mends

_POWER = ("power", "rcs", "amplitude", "intensity", "snr", "snr_db", "power_db")
_DROPPED = ("radar_points_not_finite", "radar_points_at_no_range", "radar_points_beyond_range")
_MAX_RANGE_M = 1000.0  # automotive radars have shorter ranges; larger values are damaged
_REACH_M = 300.0  # from data sheets of car radars
_FLAT_RAD = 1e-6


@dataclass(frozen=True, eq=False)
class RadarCloud:
    """Detections of one scan, radar frame; `range_rate_mps` positive = receding, not ego-compensated."""

    xyz_m: Float32[np.ndarray, "N 3"]
    range_rate_mps: Float32[np.ndarray, " N"]
    power_db: Float32[np.ndarray, " N"] | None
    has_elevation: bool
    dropped: Counter[str] = field(default_factory=Counter)
    unit: str = ""  # unit that fits, if it is not metres


@np.errstate(all="ignore")  # damaged numbers become inf or nan, and are dropped
def read_radar(message: Any, msgtype: str, config: RadarTopics) -> RadarCloud:
    """Detections of one radar message; those that are not finite or have zero range are dropped and counted.

    Velocities of a RadarTrack, and the components in `velocity_fields`, need no sign: they are relative to
    the sensor, and their component along the line of sight is the range rate.

    Raises:
        ValueError: a field is missing (the message lists the existing ones), or the layout is inconsistent.
    """
    kind = msgtype.rsplit("/", 1)[-1]
    xyz, range_rate, power = {"RadarScan": _scan, "RadarTracks": _tracks}.get(kind, _cloud)(message, config)
    range2 = np.einsum("ij,ij->i", xyz, xyz)
    keep, dropped = within(range2, _MAX_RANGE_M, _DROPPED, np.isfinite(range_rate))
    unit = unit_that_fits(np.sqrt(range2), _REACH_M) if 2 * dropped.total() > len(xyz) else ""
    xyz = xyz[keep]
    return RadarCloud(
        xyz.astype(np.float32),
        range_rate[keep].astype(np.float32),
        None if power is None else power[keep].astype(np.float32),
        bool(np.any(np.abs(xyz[:, 2]) > _FLAT_RAD * np.sqrt(range2[keep]))),
        dropped,
        unit,
    )


_Columns = tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"], Float[np.ndarray, " N"] | None]


def _cloud(message: Any, config: RadarTopics) -> _Columns:
    points = cloud_columns(message)
    names = points.dtype.names or ()
    moving = (config.doppler_field,) if config.velocity_fields is None else config.velocity_fields
    unknown = [repr(name) for name in moving if name not in names]
    if unknown:
        what = "the Doppler" if config.velocity_fields is None else "the velocity"
        there = f"there are {', '.join(names) or 'none'}"
        raise ValueError(f"no field {', '.join(unknown)} for {what}; {there}: {CORRECT_FIELD}")
    missing = [n for n in ("x", "y") if n not in names]
    if missing:
        raise ValueError(f"no field {' and '.join(missing)}; there are {', '.join(names)}")
    used = ["x", "y", *(["z"] if "z" in names else []), *moving]
    if any(points[n].ndim > 1 for n in used):
        raise ValueError(f"a field of {', '.join(used)} holds more than one value a point")
    # A planar radar has no z: it is set to 0, and has_elevation = False.
    z = points["z"] if "z" in names else 0.0
    xyz = np.empty((len(points), 3))
    xyz[:, 0], xyz[:, 1], xyz[:, 2] = points["x"], points["y"], z
    rates = np.stack([points[name].astype(np.float64) for name in moving], axis=1)
    range_rate = _receding(rates[:, 0], config) if config.velocity_fields is None else _along(xyz, rates)
    power = first_field(points, _POWER)
    return xyz, range_rate, None if power is None else power.astype(np.float64)


def _scan(message: Any, config: RadarTopics) -> _Columns:
    raw = np.array(
        [(r.range, r.azimuth, r.elevation, r.doppler_velocity, r.amplitude) for r in message.returns],
        np.float64,
    ).reshape(-1, 5)
    distance, azimuth, elevation, doppler, amplitude = raw.T
    azimuth = azimuth if config.azimuth_positive == "left" else -azimuth
    level = np.cos(elevation)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    xyz = distance[:, None] * directions
    return xyz, _receding(doppler, config), amplitude


def _tracks(message: Any, _config: RadarTopics) -> _Columns:
    both = [(v.x, v.y, v.z) for t in message.tracks for v in (t.position, t.velocity)]
    xyz, velocity = np.array(both, np.float64).reshape(-1, 2, 3).transpose(1, 0, 2)
    return xyz, _along(xyz, velocity), None


def _along(xyz: Float[np.ndarray, "N 3"], velocity: Float[np.ndarray, "N K"]) -> Float[np.ndarray, " N"]:
    """Component along the line of sight of relative velocities; of two components, the third is 0."""
    return np.einsum("ij,ij->i", xyz[:, : velocity.shape[1]], velocity) / np.linalg.norm(xyz, axis=1)


def _receding(doppler: Float[np.ndarray, " N"], config: RadarTopics) -> Float[np.ndarray, " N"]:
    return doppler if config.doppler_positive == "receding" else 0.0 - doppler  # avoids negative zeros

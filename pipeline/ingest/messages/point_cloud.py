"""PointCloud2 of any layout to columns: padding, byte order, datatypes, organised rows, missing points."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt16

__all__ = [
    "TIME_FIELDS",
    "LidarCloud",
    "cloud_columns",
    "first_field",
    "read_lidar",
    "unit_that_fits",
    "within",
]

_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_INTENSITY = ("intensity", "reflectivity", "intensities", "i", "remission", "signal")
_RING = ("ring", "channel", "line", "laser_id", "beam", "row")
TIME_FIELDS = (
    "time", "t", "timestamp", "time_stamp", "time_offset", "offset_time", "timeoffset", "timestampOffset",
    "point_time_offset",
)  # fmt: skip
# Drivers write (0, 0, 0) for a beam without return; real returns of lidar and radar are never this near.
_MIN_RANGE_M = 0.05
_DROPPED = ("lidar_points_not_finite", "lidar_points_without_return", "lidar_points_beyond_range")
_LONGEST_SWEEP_S = 1.0
# 12 days after 1970, in seconds and nanoseconds: longer than any sweep, earlier than any date.
_DATE_S, _DATE_NS = 1e6, 10**15


@dataclass(frozen=True, eq=False)
class LidarCloud:
    """Points of one sweep in its own frame; `dropped` counts removed points by reason."""

    x_m: Float32[np.ndarray, " N"]
    y_m: Float32[np.ndarray, " N"]
    z_m: Float32[np.ndarray, " N"]
    intensity: Float32[np.ndarray, " N"] | None
    ring: UInt16[np.ndarray, " N"] | None
    time_s: Float32[np.ndarray, " N"] | None
    dropped: Counter[str] = field(default_factory=Counter)
    unit: str = ""  # unit that fits, if it is not metres


def cloud_columns(message: Any) -> np.ndarray:
    """All points of a sensor_msgs/PointCloud2 as one structured array (a view where rows are not padded).

    Raises:
        ValueError: the layout is inconsistent, or the data is shorter than it requires.
    """
    height, width, step, row_step = (
        int(v) for v in (message.height, message.width, message.point_step, message.row_step)
    )
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for f in message.fields:
        if int(f.datatype) not in _DATATYPES:
            raise ValueError(f"field {f.name!r} has the unknown datatype {f.datatype}")
        kind, count = order + _DATATYPES[int(f.datatype)], int(f.count)
        names.append(str(f.name))
        formats.append((kind, (count,)) if count > 1 else kind)  # 0 violates the standard but is common
        offsets.append(int(f.offset))
    if height * width == 0:
        return np.zeros(0, np.dtype([(n, fmt) for n, fmt in zip(names, formats, strict=True)]))
    if step < 1 or (height > 1 and row_step < width * step):
        raise ValueError(f"point_step {step} and row_step {row_step} contradict {width} points a row")
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    data = np.ascontiguousarray(message.data, np.uint8)
    row = width * step
    if len(data) < (height - 1) * row_step + row:
        raise ValueError(f"{len(data)} bytes of data are too few for {height}x{width} points of {step} bytes")
    if height > 1 and row_step != row:
        rows = np.lib.stride_tricks.as_strided(data, (height, row), (row_step, 1))
        return np.ascontiguousarray(rows).reshape(-1).view(dtype)
    return data[: height * row].view(dtype)


def first_field(points: np.ndarray, names: tuple[str, ...]) -> np.ndarray | None:
    """First of these fields (case-insensitive) that the cloud has as a scalar column, else None."""
    found = {str(n).lower(): n for n in reversed(points.dtype.names or ())}
    for name in names:
        if name.lower() in found:
            column = points[found[name.lower()]]
            if column.ndim == 1:
                return column
    return None


@np.errstate(all="ignore")  # damaged numbers become inf or nan, and are dropped
def read_lidar(message: Any, stamp_ns: int, max_range_m: float) -> LidarCloud:
    """Finite points of a sweep within range; intensity, ring and time if the cloud has them.

    Args:
        stamp_ns: the sweep's stamp; times become seconds relative to it, for all conventions of the log.

    Raises:
        ValueError: no x, y, z, or an inconsistent layout.
    """
    points = cloud_columns(message)
    x, y, z = _coordinates(points)
    range2 = x * x + y * y + z * z
    keep, dropped = within(range2, max_range_m, _DROPPED)
    intensity, ring = first_field(points, _INTENSITY), first_field(points, _RING)
    return LidarCloud(
        x[keep], y[keep], z[keep], None if intensity is None else intensity[keep].astype(np.float32),
        _ring(ring, keep), _relative_time_s(first_field(points, TIME_FIELDS), keep, stamp_ns), dropped,
        unit_that_fits(np.sqrt(range2), max_range_m) if 2 * dropped.total() > len(x) else "",
    )  # fmt: skip


def _coordinates(points: np.ndarray) -> list[Float32[np.ndarray, " N"]]:
    names = points.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"no fields x, y, z; there are {', '.join(names) or 'none'}")
    if any(points[n].ndim > 1 for n in "xyz"):
        raise ValueError("a field of x, y, z holds more than one value a point")
    return [points[n].astype(np.float32) for n in "xyz"]


def within(
    range2: Float[np.ndarray, " N"],
    max_range_m: float,
    reasons: tuple[str, str, str],
    is_measured: bool | Bool[np.ndarray, " N"] = True,
) -> tuple[slice | Bool[np.ndarray, " N"], Counter[str]]:
    """Index of the measured points within range, and counts of dropped points by reason.

    Args:
        range2: squared distances [m^2].
        reasons: names of the counts of points that are not finite, that are too near, and that are too far.
    """
    keep = (range2 >= _MIN_RANGE_M**2) & (range2 <= max_range_m**2) & is_measured  # False for NaN
    if keep.all():
        return slice(None), Counter()
    finite, near = np.isfinite(range2) & is_measured, range2 < _MIN_RANGE_M**2
    counts = (int(np.sum(of)) for of in (~finite, finite & near, finite & ~near & ~keep))
    return keep, +Counter(dict(zip(reasons, counts, strict=True)))


def _ring(ring: np.ndarray | None, keep: slice | Bool[np.ndarray, " N"]) -> UInt16[np.ndarray, " M"] | None:
    if ring is None:
        return None
    kept = ring[keep]
    if kept.dtype.kind == "u" and kept.dtype.itemsize <= 2:
        return kept.astype(np.uint16)
    if kept.dtype.kind == "f" and not np.all(np.isfinite(kept) & (kept == np.round(kept))):
        return None
    return kept.astype(np.uint16) if np.all((kept >= 0) & (kept < 65536)) else None


def _relative_time_s(
    time: np.ndarray | None, keep: slice | Bool[np.ndarray, " N"], stamp_ns: int
) -> Float32[np.ndarray, " M"] | None:
    """Seconds after the stamp: floats are seconds, integers nanoseconds; large values are absolute.

    None if the result is not a time within a sweep: no de-skew is better than a wrong one.
    """
    if time is None or not len(time):
        return None
    kept = time[keep]
    if kept.dtype.kind == "f":
        if len(kept) and abs(float(kept[0])) > _DATE_S:
            if kept.dtype.itemsize < 8:
                return None  # float32 cannot hold a date: its steps are minutes long
            # Whole seconds first, so that the difference keeps its nanoseconds.
            kept = (kept - stamp_ns // 10**9) - (stamp_ns % 10**9) * 1e-9
        seconds = kept.astype(np.float32)
    else:
        ticks = kept.astype(np.int64)
        ticks = ticks - stamp_ns if len(ticks) and ticks[0] > _DATE_NS else ticks
        seconds = (ticks * 1e-9).astype(np.float32)
    return seconds if np.all(np.abs(seconds) < _LONGEST_SWEEP_S) else None  # False for NaN too


_IN_METRES = {"millimetres": 1e-3, "centimetres": 1e-2}
# Distance of the nearest tenth of a car's points: the road around the car, or what a radar detects on an
# empty one. It separates the units; nine tenths of the points must also be within the sensor's reach.
_NEAREST_M, _MOST = (1.0, 60.0), 0.9


def unit_that_fits(distance: Float[np.ndarray, " N"], reach_m: float) -> str:
    """Unit at which distances are plausible (at most `reach_m`); empty for metres or no match."""
    distance = distance[np.isfinite(distance) & (distance > 0)]
    if not len(distance):
        return ""
    nearest, farthest = np.quantile(distance, [0.1, _MOST])
    if nearest >= _NEAREST_M[0] / 10 and farthest <= reach_m:
        return ""
    typical = float(np.sqrt(np.prod(_NEAREST_M)))
    unit = min(_IN_METRES, key=lambda name: abs(np.log(max(nearest, 1e-9) * _IN_METRES[name] / typical)))
    metres = _IN_METRES[unit]
    is_near = _NEAREST_M[0] <= nearest * metres <= _NEAREST_M[1]
    return unit if is_near and farthest * metres <= reach_m else ""

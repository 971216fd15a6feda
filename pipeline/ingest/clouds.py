"""PointCloud2 of any layout to columns: offsets and padding, either byte order, any datatype, organised rows, missing points."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt16

__all__ = ["LidarCloud", "cloud_columns", "first_field", "read_lidar"]

_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_INTENSITY = ("intensity", "reflectivity", "intensities", "i", "remission", "signal")
_RING = ("ring", "channel", "line", "laser_id", "beam", "row")
_TIME = (
    "time",
    "t",
    "timestamp",
    "time_stamp",
    "time_offset",
    "offset_time",
    "timeoffset",
    "timestampOffset",
    "point_time_offset",
)
_MIN_RANGE_M = (
    0.05  # drivers write (0, 0, 0) for a beam without return; no sensor sees its own housing this near
)
_LONGEST_SWEEP_S = 1.0


@dataclass(frozen=True, eq=False)
class LidarCloud:
    """Points of one sweep in its own frame; `dropped` counts by reason the points that the message had and this has not."""

    xyz_m: Float32[np.ndarray, "N 3"]
    intensity: Float32[np.ndarray, " N"] | None
    ring: UInt16[np.ndarray, " N"] | None
    time_s: Float32[np.ndarray, " N"] | None
    dropped: Counter[str] = field(default_factory=Counter)


def cloud_columns(message: Any) -> np.ndarray:
    """All points of a sensor_msgs/PointCloud2 as one structured array (a view where rows are not padded).

    Raises:
        ValueError: the layout contradicts itself or the data is shorter than the layout says.
    """
    height, width, step, row_step = (
        int(v) for v in (message.height, message.width, message.point_step, message.row_step)
    )
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for f in message.fields:
        if int(f.datatype) not in _DATATYPES:
            raise ValueError(f"field {f.name!r} has the unknown datatype {f.datatype}")
        count = max(int(f.count), 1)  # 0 is against the standard but common
        names.append(str(f.name))
        formats.append(
            (order + _DATATYPES[int(f.datatype)], (count,))
            if count > 1
            else order + _DATATYPES[int(f.datatype)]
        )
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
    """The first of these fields that the cloud has (compared without case) as a scalar column, None where it has none."""
    found = {str(n).lower(): n for n in reversed(points.dtype.names or ())}
    for name in names:
        if name.lower() in found:
            column = points[found[name.lower()]]
            if column.ndim == 1:
                return column
    return None


def read_lidar(message: Any, stamp_ns: int, max_range_m: float) -> LidarCloud:
    """A sweep's finite points within range; intensity, ring and time where the cloud has them.

    Args:
        message: sensor_msgs/PointCloud2 with x, y, z [m] in the lidar frame.
        stamp_ns: the sweep's stamp; times become seconds relative to it, whatever they count in the log.
        max_range_m: points beyond are dropped and counted.

    Raises:
        ValueError: no x, y, z, or a layout that contradicts itself.
    """
    points = cloud_columns(message)
    xyz = _xyz(points)
    range2 = np.einsum("ij,ij->i", xyz, xyz)
    finite = np.isfinite(range2)
    near, far = finite & (range2 < _MIN_RANGE_M**2), finite & (range2 > max_range_m**2)
    keep = finite & ~near & ~far
    dropped = Counter({
        "lidar_points_not_finite": int(np.sum(~finite)),
        "lidar_points_without_return": int(np.sum(near)),
        "lidar_points_beyond_range": int(np.sum(far)),
    })  # fmt: skip
    intensity, ring = first_field(points, _INTENSITY), first_field(points, _RING)
    return LidarCloud(
        xyz[keep],
        None if intensity is None else intensity[keep].astype(np.float32),
        _ring(ring, keep),
        _relative_time_s(first_field(points, _TIME), keep, stamp_ns),
        +dropped,
    )


def _xyz(points: np.ndarray) -> Float32[np.ndarray, "N 3"]:
    names = points.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"no fields x, y, z; there are {', '.join(names) or 'none'}")
    if any(points[n].ndim > 1 for n in "xyz"):
        raise ValueError("a field of x, y, z holds more than one value a point")
    xyz = np.empty((len(points), 3), np.float32)
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # float64 garbage becomes inf and is dropped as not finite
        for i, name in enumerate("xyz"):
            xyz[:, i] = points[name]
        xyz[~(np.abs(xyz) < 1e9).all(axis=1)] = np.nan  # squares stay finite below
    return xyz


def _ring(ring: np.ndarray | None, keep: Bool[np.ndarray, " N"]) -> UInt16[np.ndarray, " M"] | None:
    if ring is None:
        return None
    kept = ring[keep]
    if kept.dtype.kind == "f" and not np.all(np.isfinite(kept) & (kept == np.round(kept))):
        return None
    return kept.astype(np.uint16) if np.all((kept >= 0) & (kept < 65536)) else None


def _relative_time_s(
    time: np.ndarray | None, keep: Bool[np.ndarray, " N"], stamp_ns: int
) -> Float32[np.ndarray, " M"] | None:
    """Seconds after the stamp. Floats count seconds, integers nanoseconds; absolute where they are of the size of the stamp.

    None where the result is no time within a sweep: better no de-skew than a wrong one.
    """
    if time is None:
        return None
    kept = time[keep]
    if kept.dtype.kind == "f":
        seconds = kept.astype(np.float64)
        if len(seconds) and not np.all(np.isfinite(seconds)):
            return None
        if len(seconds) and abs(float(np.median(seconds))) > 1e6:
            # float32 cannot hold an absolute time: its steps are minutes long
            seconds = seconds - stamp_ns * 1e-9 if kept.dtype.itemsize == 8 else np.full_like(seconds, np.inf)
    else:
        ticks = kept.astype(np.int64)
        absolute = len(ticks) and abs(int(np.median(ticks))) > 10**15
        seconds = (ticks - (stamp_ns if absolute else 0)) * 1e-9
    return seconds.astype(np.float32) if np.all(np.abs(seconds) < _LONGEST_SWEEP_S) else None

"""A drive of a data set: intrinsics, sensor poses on the car, and events of each sensor; its files of numbers."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from pipeline.core.errors import ConfigError
from pipeline.rig.cameras import Camera
from pipeline.rig.graph import Kind
from pipeline.rig.se3 import inverse, log_so3

__all__ = [
    "Event",
    "Recording",
    "ego_events",
    "read_bytes",
    "read_float_rows",
    "read_json",
    "read_pcd",
]

_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}


class Event(NamedTuple):
    """One measurement; `load` returns JPEG or PNG bytes, columns of points by name, or motion.

    Motion is T_odom_base, forward speed [m/s], yaw rate [rad/s, positive to the left].
    """

    stamp_ns: int
    sensor: str  # name of the sensor, or ego
    load: Callable[[], Any]


@dataclass(frozen=True, eq=False)
class Recording:
    """One drive.

    Args:
        T_base: T_base_sensor of cameras (optical), lidars and radars (both x forward, y left, z up), by name.
        events: in order of their stamps; radar columns hold x, y, z, doppler (range rate, positive =
            receding).
    """

    vehicle: str
    day: str
    name: str
    kinds: Mapping[str, Kind]
    cameras: Mapping[str, Camera]
    T_base: Mapping[str, Float[np.ndarray, "4 4"]]
    events: Sequence[Event]


def ego_events(stamps_ns: Sequence[int], T_odom_base: Sequence[Float[np.ndarray, "4 4"]]) -> list[Event]:
    """Odometry from poses at increasing stamps: motion between neighbours."""
    events = []
    for k, (stamp, T) in enumerate(zip(stamps_ns, T_odom_base, strict=True)):
        before, after = max(k - 1, 0), min(k + 1, len(stamps_ns) - 1)
        dt_s = (stamps_ns[after] - stamps_ns[before]) / 1e9
        if dt_s <= 0:
            continue
        step = inverse(T_odom_base[before]) @ T_odom_base[after]
        motion = T, float(step[0, 3] / dt_s), float(log_so3(step[:3, :3])[2] / dt_s)
        events.append(Event(stamp, "ego", partial(tuple, motion)))
    return events


def read_bytes(path: Path) -> bytes:
    """Content of a file; raises ConfigError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as err:
        raise ConfigError(str(path), "", f"cannot be read: {err.strerror}") from err


def read_json(path: Path) -> Any:
    """Value of a JSON file; raises ConfigError if it cannot be read, or is not JSON."""
    try:
        return json.loads(read_bytes(path))
    except ValueError as err:
        raise ConfigError(str(path), "", f"not readable JSON: {err}") from err


def read_float_rows(path: Path, columns: int) -> Float32[np.ndarray, "N C"]:
    """Rows of little-endian float32, as in KITTI's .bin; raises ConfigError if the size does not fit."""
    data = read_bytes(path)
    if len(data) % (4 * columns):
        raise ConfigError(str(path), "", f"{len(data)} bytes are not rows of {columns} float32")
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def read_pcd(path: Path) -> np.ndarray:
    """Points of a binary PCD 0.7 file; raises ConfigError if missing, or its header does not fit its size."""
    data = read_bytes(path)
    head, separator, body = data.partition(b"DATA binary\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    header = {line[0]: line[1:] for line in lines if line}
    try:
        columns = zip(header["FIELDS"], header["TYPE"], header["SIZE"], strict=True)
        dtype = np.dtype([(name, f"<{_PCD_TYPES[kind]}{size}") for name, kind, size in columns])
        count = int(header["POINTS"][0])
        is_single = set(header.get("COUNT", ["1"])) == {"1"}
    except (KeyError, IndexError, ValueError, TypeError) as err:
        raise ConfigError(str(path), "", f"not a readable PCD: {type(err).__name__} {err}") from err
    if not separator or not is_single or len(body) < count * dtype.itemsize:
        raise ConfigError(str(path), "DATA", f"needs {count} binary points of single numbers")
    return np.frombuffer(body, dtype, count)

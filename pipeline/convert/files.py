"""Files of data sets: tables of numbers, JSON, point clouds; errors name the file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from pipeline.core.errors import ConfigError

__all__ = ["read_bytes", "read_float_rows", "read_json", "read_pcd"]

_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}


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
        kinds = [
            f"<{_PCD_TYPES[kind]}{size}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)
        ]
        dtype = np.dtype(list(zip(header["FIELDS"], kinds, strict=True)))
        count = int(header["POINTS"][0])
        is_single = set(header.get("COUNT", ["1"])) == {"1"}
    except (KeyError, IndexError, ValueError, TypeError) as err:
        raise ConfigError(str(path), "", f"not a readable PCD: {type(err).__name__} {err}") from err
    if not separator or not is_single or len(body) < count * dtype.itemsize:
        raise ConfigError(str(path), "DATA", f"needs {count} binary points of single numbers")
    return np.frombuffer(body, dtype, count)

"""JSON and YAML: floats with all their digits, errors with file and field."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import RoundTripRepresenter

from pipeline.core.errors import ConfigError
from pipeline.core.results import plain
from pipeline.rig.se3 import from_quaternion

__all__ = [
    "edit_yaml",
    "field_of",
    "load_json",
    "load_yaml",
    "matrix_of",
    "number_of",
    "pose_of_quaternion",
    "text_of",
    "to_json",
    "to_yaml",
]

# As in `extrinsics.prior`: matrices with three or four digits are accepted as rotations.
_ROTATION_TOLERANCE = 1e-3
_NORM_TOLERANCE = 0.01  # as `TransformTree`: largest deviation of a quaternion's length from 1


def text_of(file: str, content: bytes) -> str:
    """Text of a file; raises ConfigError if it is not UTF-8."""
    try:
        return content.decode()
    except UnicodeDecodeError as err:
        raise ConfigError(file, "", f"is not UTF-8 text: {err.reason} at byte {err.start}") from err


def to_json(value: Any) -> bytes:
    """Indented JSON; floats keep all bits, non-finite numbers become null."""
    return (json.dumps(plain(value), indent=2, allow_nan=False) + "\n").encode()


def load_json(file: str, content: bytes) -> Any:
    """Value of a JSON file; raises ConfigError if it is not JSON."""
    return _read(file, content, json.loads, "JSON")


def to_yaml(value: Mapping[str, Any], comments: Sequence[str]) -> bytes:
    """Block-style YAML under comment lines; lists of numbers on one line, floats with all their digits."""
    text = _dump(_round_trip(), _styled(plain(value)))
    return "".join(f"# {line}\n" for line in comments).encode() + text


def load_yaml(file: str, content: bytes) -> Any:
    """Value of a YAML file without OpenCV's first line `%YAML:1.0`; raises ConfigError if it is not YAML."""
    if content.startswith(b"%YAML:"):
        content = content.partition(b"\n")[2]
    return _read(file, content, YAML(typ="safe", pure=True).load, "YAML")


def edit_yaml(file: str, content: bytes, edit: Callable[[Any], None]) -> bytes:
    """Change values of a YAML file in place; other values, their order and all comments stay."""
    yaml = _round_trip()
    held = _read(file, content, yaml.load, "YAML")
    edit(held)
    return _dump(yaml, held)


def _read(file: str, content: bytes, load: Callable[[str], Any], kind: str) -> Any:
    try:
        return load(text_of(file, content))
    except (YAMLError, ValueError, RecursionError) as err:
        raise ConfigError(file, "", f"not readable {kind}: {' '.join(str(err).split())[:200]}") from err


def _round_trip() -> YAML:
    yaml = YAML()
    yaml.Representer = _Representer
    yaml.preserve_quotes = True
    yaml.width = 4096  # keeps a row of numbers on one line
    return yaml


def _dump(yaml: YAML, value: Any) -> bytes:
    stream = io.BytesIO()
    yaml.dump(value, stream)
    return stream.getvalue()


def field_of(file: str, value: Any, *path: str | int) -> Any:
    """Value at a path of keys and indices; raises ConfigError with the path up to the missing part."""
    for depth, key in enumerate(path):
        where = ".".join(str(p) for p in path[: depth + 1])
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError) as err:
            raise ConfigError(file, where, "missing") from err
    return value


def number_of(file: str, value: Any, *path: str | int) -> float:
    """Finite number at a path; raises ConfigError if there is none."""
    found = field_of(file, value, *path)
    where = ".".join(str(p) for p in path)
    if isinstance(found, bool) or not isinstance(found, int | float):
        raise ConfigError(file, where, f"{found!r} is not a number")
    if not np.isfinite(found):
        raise ConfigError(file, where, f"{found!r} is not finite")
    return float(found)


def matrix_of(file: str, key: str, values: Any) -> Float[np.ndarray, "4 4"]:
    """T from 3x4 or 4x4 numbers, nested or flat, bit for bit; raises ConfigError if not rigid."""
    try:
        flat = np.array(values, np.float64).reshape(-1)
    except (TypeError, ValueError) as err:
        raise ConfigError(file, key, "is not a matrix of numbers") from err
    if flat.size not in (12, 16) or not np.all(np.isfinite(flat)):
        raise ConfigError(file, key, f"needs 12 or 16 finite numbers, row by row, and has {flat.size}")
    T = np.vstack([flat[:12].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    if flat.size == 16 and not np.array_equal(flat[12:], [0, 0, 0, 1]):
        raise ConfigError(file, key, "its last row is not 0 0 0 1")
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE) or np.linalg.det(R) < 0:
        raise ConfigError(file, key, "its 3x3 part is not a rotation")
    return T


def pose_of_quaternion(
    file: str, key: str, q_wxyz: Sequence[float], t_m: Sequence[float]
) -> Float[np.ndarray, "4 4"]:
    """T from a unit quaternion, scalar first, and a translation [m]; else ConfigError."""
    q, t = np.array(q_wxyz, np.float64), np.array(t_m, np.float64)
    if q.shape != (4,) or t.shape != (3,) or not np.all(np.isfinite([*q, *t])):
        raise ConfigError(file, key, "needs four and three finite numbers")
    if abs(np.linalg.norm(q) - 1) > _NORM_TOLERANCE:
        raise ConfigError(file, key, f"its quaternion has length {np.linalg.norm(q):.4g}, not 1")
    return from_quaternion(q, t)


class _Representer(RoundTripRepresenter):
    """Writes floats with a decimal point: YAML 1.1, which most cars read, parses 1e-17 as a string."""


def _float(representer: RoundTripRepresenter, value: float) -> ScalarNode:
    text = repr(float(value))
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return representer.represent_scalar("tag:yaml.org,2002:float", text)


_Representer.add_representer(float, _float)


def _styled(value: Any) -> Any:
    """Copy with maps in block style and rows of numbers in flow style."""
    if isinstance(value, Mapping):
        return CommentedMap((key, _styled(v)) for key, v in value.items())
    if isinstance(value, (list, tuple)):
        styled = CommentedSeq(_styled(v) for v in value)
        if all(isinstance(v, int | float) for v in value):
            styled.fa.set_flow_style()
        return styled
    return value

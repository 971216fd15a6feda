"""Poses as columns of a row, and back: quaternion (scalar first) and origin [m]."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.rig.se3 import from_quaternion, to_quaternion
from schemas.columns import POSE_COLUMNS

__all__ = ["pose_columns", "pose_of"]


def pose_columns(T: Float[np.ndarray, "4 4"] | None, prefix: str = "") -> dict[str, Any]:
    """Columns of a pose, their names with a prefix; all null without a pose."""
    values = [None] * 7 if T is None else [float(v) for v in (*to_quaternion(T), *T[:3, 3])]
    return {f"{prefix}{name}": value for name, value in zip(POSE_COLUMNS, values, strict=True)}


def pose_of(column: Callable[[str], Any], prefix: str = "") -> Float[np.ndarray, "4 4"] | None:
    """The pose in the columns of a prefix, each given by its name; None if one is null."""
    values = [column(prefix + name) for name in POSE_COLUMNS]
    return None if None in values else from_quaternion(np.array(values[:4]), np.array(values[4:]))

"""Rows of several frames: those of some of them, and least squares on them kept apart by frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int64

from pipeline.core.rows import take_rows

__all__ = ["equations_by_frame", "robust_equations", "rows_of_frames", "spread_of"]

_Rows = TypeVar("_Rows")
_LEAST_ROWS = 5  # fewer have no spread to weigh them by
_LEAST_SIGMA_RAD = np.radians(0.3)  # box edges are no better


def rows_of_frames(rows: _Rows, frames: Int64[np.ndarray, " S"]) -> _Rows:
    """The rows of these frames, which are renumbered in the given order."""
    held: Any = rows
    place = np.full(int(max(held.frame.max(initial=-1), frames.max(initial=-1))) + 1, -1, np.int64)
    place[frames] = np.arange(len(frames))
    index = np.flatnonzero(place[held.frame] >= 0)
    return replace(take_rows(held, index), frame=place[held.frame[index]])


def spread_of(residual: Float[np.ndarray, " B"]) -> float:
    """Robust standard deviation."""
    return float(1.4826 * np.median(np.abs(residual - np.median(residual))))


def equations_by_frame(
    weight: Float[np.ndarray, " B"],
    residual: Float[np.ndarray, " B"],
    J: Float[np.ndarray, "B P"],
    frame: Int64[np.ndarray, " B"],
    frames: int,
) -> tuple[Float[np.ndarray, "F P P"], Float[np.ndarray, "F P"]]:
    """Information and gradient of the weighted squares, per frame."""
    P = J.shape[1]
    H, g = np.zeros((frames, P, P)), np.zeros((frames, P))
    np.add.at(H, frame, weight[:, None, None] * J[:, :, None] * J[:, None, :])
    np.add.at(g, frame, (weight * residual)[:, None] * J)
    return H, g


def robust_equations(
    residual: Float[np.ndarray, " B"],
    J: Float[np.ndarray, "B P"],
    frame: Int64[np.ndarray, " B"],
    frames: int,
) -> tuple[Float[np.ndarray, "F P P"], Float[np.ndarray, "F P"], float]:
    """Per frame, information and gradient of the robust (Cauchy) cost of angles, and the residuals' own sigma [rad].

    Equations are zero, and sigma is NaN, where residuals are too few to show their spread.
    """
    if len(residual) < _LEAST_ROWS:
        none = np.zeros(0)
        return *equations_by_frame(none, none, J[:0], frame[:0], frames), float("nan")
    sigma = max(spread_of(residual), _LEAST_SIGMA_RAD)
    weight = 1 / (1 + (residual / (2 * sigma)) ** 2) / sigma**2
    return *equations_by_frame(weight, residual, J, frame, frames), sigma

"""Rounding of transforms whose difference no sensor can measure."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.rig.se3 import exp_so3, from_rotation_translation, log_so3

__all__ = ["on_grid"]

_CELL = 1e-4  # rad and m: .006 deg, a tenth of the sigma on the best day
# As fraction of a cell: keeps borders of cells away from numbers with up to five digits, as in files.
_OFFSET = 0.137


def on_grid(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The transform at the middle of its cell: at most half a cell away in each component."""
    numbers = np.concatenate([log_so3(T[:3, :3]), T[:3, 3]])
    middle = (np.floor(numbers / _CELL + _OFFSET) + 0.5 - _OFFSET) * _CELL
    return from_rotation_translation(exp_so3(middle[:3]), middle[3:])

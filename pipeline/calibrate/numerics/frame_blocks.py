"""Blocks of frames that share scenes, so that blocks and not frames count as independent. Two rules for two uses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int, Int64

from schemas.observations import Observation

__all__ = ["bootstrap_blocks", "scene_blocks"]

_FEWEST_BLOCKS = 8  # with fewer, neither a bootstrap nor a scatter over blocks knows its own spread


def bootstrap_blocks(drive: Int64[np.ndarray, " F"], most: int = 24) -> Int64[np.ndarray, " F"]:
    """Block number of each frame, for resampling: blocks of about equal size. Long drives are cut, short ones joined.

    Args:
        drive: drive of each frame, in order of time.
        most: about so many blocks; at least 8 where there are as many frames.
    """
    F = len(drive)
    if F == 0:
        return np.zeros(0, np.int64)
    size = max(1, F // max(most, _FEWEST_BLOCKS))
    block = np.zeros(F, np.int64)
    number, filled = 0, 0
    for f in range(1, F):
        filled += 1
        # End a full block where the drive ends, or anyway at twice its size.
        if filled >= size and (drive[f] != drive[f - 1] or filled >= 2 * size):
            number, filled = number + 1, 0
        block[f] = number
    return block


def scene_blocks(
    observations: Sequence[Observation], at_least: int = _FEWEST_BLOCKS
) -> Int[np.ndarray, " F"]:
    """Block name of each frame, for scatter over scenes: its drive, whatever its length.

    Where the day has fewer drives than `at_least`, that many stretches of equally many frames.
    """
    drives = np.array([o.drive for o in observations])
    if len(np.unique(drives)) >= at_least:
        return drives
    return np.arange(len(observations)) * at_least // max(len(observations), 1)

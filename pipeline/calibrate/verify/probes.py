"""Held-out frames at known rotations of the result: a test whether they would reject a prior rotated like this.

A record that lies many sigmas from its prior is held unless held-out frames align better at the result than at
the prior. To find the smallest error of the prior that would be detected, this test is made for errors that
the prior does not have.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int

from pipeline.calibrate.verify.held_out_test import paired_test
from pipeline.rig.sensor_turns import sensor_turn
from schemas.calibrations import PROBE_Z

__all__ = ["probe_numbers"]

# Axes that the comparison of held-out frames depends on.
_PROBED = {"camera_lidar": ("azimuth", "elevation", "roll"), "lidar_radar": ("azimuth",)}


def probe_numbers(
    pair: str,
    T: Float[np.ndarray, "4 4"],
    cost: Callable[[np.ndarray], np.ndarray],
    blocks: Int[np.ndarray, " F"],
    sizes_deg: Sequence[float],
) -> dict[str, float]:
    """Deviate z of the paired test by turn, negative = held-out frames prefer the result; for diagnostics.

    Args:
        pair: pair whose camera or radar is rotated.
        T: the result.
        cost: cost of each held-out frame at a pose of the pair.
        blocks: scene of each held-out frame.
        sizes_deg: sizes of the rotations; both signs are tested.
    """
    found, after = dict[str, float](), cost(T) if sizes_deg else np.zeros(0)
    for axis in _PROBED.get(pair, ()):
        for deg in (sign * size for size in sizes_deg for sign in (1.0, -1.0)):
            of_camera = pair == "camera_lidar"
            R = sensor_turn(axis, float(np.radians(deg)), of_camera=of_camera)
            test = paired_test(cost(np.linalg.inv(R) @ T if of_camera else T @ R), after, blocks)
            if test is not None:
                found[f"{PROBE_Z}{axis}_{deg:+g}"] = test.z
    return found

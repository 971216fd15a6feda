"""The car's speed by one radar scan, roughly: for logs without odometry, before anything is calibrated."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["doppler_speed"]

_FIT_MPS = 0.35  # static points fit the ego speed this well in Doppler, quantisation included


def doppler_speed(
    directions: Float[np.ndarray, "N 3"], range_rate_mps: Float[np.ndarray, " N"], period_mps: float | None
) -> tuple[float, float]:
    """Forward speed [m/s] whose static world fits most detections of a scan, and the share that it fits.

    The directions' x axis is taken to point along the driving direction; a share below a third says that this is not
    so, or that the Doppler is not what the configuration says. Negative = its sign is wrong, or the car reverses.
    """
    speeds = np.arange(-45.0, 45.01, 0.15)
    misfit = range_rate_mps + speeds[:, None] * directions[:, 0]
    if period_mps is not None:
        misfit = (misfit + period_mps / 2) % period_mps - period_mps / 2
    share = np.mean(np.abs(misfit) < _FIT_MPS, axis=1)
    # Equal fits (aliases, or no detection off the axis) go to the slowest speed.
    best = int(np.lexsort((np.abs(speeds), -np.round(share, 2)))[0])
    return float(speeds[best]), float(share[best])

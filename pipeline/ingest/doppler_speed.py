"""Rough speed of the car from one radar scan: for logs without odometry, before any calibration."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["doppler_speed"]

_FIT_MPS = 0.35  # Doppler residual of static points at the right ego speed, quantisation included


def doppler_speed(
    directions: Float[np.ndarray, "N 3"], range_rate_mps: Float[np.ndarray, " N"], period_mps: float | None
) -> tuple[float, float]:
    """Forward speed [m/s] at which most detections of a scan fit a static world, and the share that fits.

    The x axis of the directions is assumed to point along the driving direction. If the share is below a
    third, this is not so, or the configuration of the Doppler is wrong. Negative speed = wrong sign, or the
    car reverses.
    """
    speeds = np.arange(-45.0, 45.01, 0.15)
    misfit = range_rate_mps + speeds[:, None] * directions[:, 0]
    if period_mps is not None:
        misfit = (misfit + period_mps / 2) % period_mps - period_mps / 2
    share = np.mean(np.abs(misfit) < _FIT_MPS, axis=1)
    # Among equal fits (aliases, or no detection off the axis) the slowest speed is chosen.
    best = int(np.lexsort((np.abs(speeds), -np.round(share, 2)))[0])
    return float(speeds[best]), float(share[best])

"""Aliasing period of a radar's Doppler, tested on the log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.ingest.directions_and_units import AskedRadar
from pipeline.ingest.doppler_speed import doppler_speed
from schemas.frames import Frame

__all__ = ["doppler_period"]

_FEWEST_SCANS = 3  # scans that no speed explains without a period
_HALF = 0.5  # share of a scan's detections explained by one speed: then no period is needed
# increase of the explained share by a period, and share of scans with that increase
_MORE, _MOST = 0.1, 2 / 3
_MOST_STEPS = 4096  # most distinct values of a quantised Doppler; with more it is not quantised


def doppler_period(frames: Sequence[Frame], radar: AskedRadar) -> float | None:
    """Aliasing period of the Doppler [m/s]; None if it is not aliased or the log does not show it.

    An aliased Doppler fills the range of one period for any speed of the car, so the observed range is tried.
    It is accepted if, in most scans that no speed explains without it, a static world explains more
    detections with it.
    """
    scans = [(radar.directions(f), f.radar_range_rate_mps.astype(np.float64)) for f in frames if _has_scan(f)]
    if len(scans) < _FEWEST_SCANS:
        return None
    values = np.unique(np.round(np.concatenate([rates for _, rates in scans]), 4))
    steps = np.diff(values)
    span = float(values[-1] - values[0])
    step = float(np.median(steps)) if len(steps) else 0.0
    if step <= 0:
        return None
    period = span + (step if span / step < _MOST_STEPS else 0.0)
    plain = np.array([doppler_speed(d, r, None)[1] for d, r in scans])
    wrapped = np.array([doppler_speed(d, r, period)[1] for d, r in scans])
    gained = (wrapped > plain + _MORE)[plain < _HALF]
    return period if len(gained) >= _FEWEST_SCANS and gained.mean() >= _MOST else None


def _has_scan(frame: Frame) -> bool:
    return "radar" in frame.sensors and len(frame.radar_xyz_m) > 0

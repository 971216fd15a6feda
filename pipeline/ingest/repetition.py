"""Data that a sensor delivers again under a new stamp: a stuck driver, a frozen picture.

What a sensor measures differs from moment to moment by its noise, of a car that stands too. So no two pictures, sweeps
or scans of a day are alike to the byte. A list of a few objects may be: it is left alone.
"""

from __future__ import annotations

from pipeline.ingest.messages.point_cloud import LidarCloud
from pipeline.ingest.messages.radar import RadarCloud
from pipeline.ingest.sync import Rejection

__all__ = ["REPEATED", "Repetitions"]

REPEATED = {
    "camera": Rejection.IMAGE_REPEATED,
    "lidar": Rejection.LIDAR_REPEATED,
    "radar": Rejection.RADAR_REPEATED,
}
_FEWEST_POINTS = 10


class Repetitions:
    """Remembers what a sensor delivered so far."""

    def __init__(self) -> None:
        self._seen: set[int] = set()

    def is_new(self, measured: LidarCloud | RadarCloud | bytes) -> bool:
        """Whether no picture, sweep or scan before was the same, whatever its stamp."""
        content = _content(measured)
        if not content:
            return True
        # A day's thousands of captures share none of 2**64 values by chance, in a third of a digest's time.
        known = hash(content) in self._seen
        self._seen.add(hash(content))
        return not known


def _content(part: LidarCloud | RadarCloud | bytes) -> tuple[bytes, ...]:
    """What was measured, without stamps; empty where equal ones may be two measurements."""
    if isinstance(part, LidarCloud):
        return part.x_m.tobytes(), part.y_m.tobytes(), part.z_m.tobytes()
    if isinstance(part, RadarCloud):
        few = len(part.xyz_m) < _FEWEST_POINTS
        return () if few else (part.xyz_m.tobytes(), part.range_rate_mps.tobytes())
    return (part,)

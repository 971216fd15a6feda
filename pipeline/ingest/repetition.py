"""Detection of repeated data under a new stamp: a stuck driver, a frozen image.

Noise makes measurements differ between moments, even when the car stands. So no two images, sweeps or scans
of a day are equal to the byte. A list of a few objects may be; it is not checked.
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
    """Hashes of the captures that a sensor delivered so far."""

    def __init__(self) -> None:
        self._seen: set[int] = set()

    def is_new(self, measured: LidarCloud | RadarCloud | bytes) -> bool:
        """Whether this image, sweep or scan is new, apart from its stamp."""
        content = _content(measured)
        if not content:
            return True
        # Random collisions among a day's thousands of captures are negligible with 2**64 values, at a third
        # of a digest's time.
        known = hash(content) in self._seen
        self._seen.add(hash(content))
        return not known


def _content(part: LidarCloud | RadarCloud | bytes) -> tuple[bytes, ...]:
    """Measured content, without stamps; empty if equal content may be two measurements."""
    if isinstance(part, LidarCloud):
        return part.x_m.tobytes(), part.y_m.tobytes(), part.z_m.tobytes()
    if isinstance(part, RadarCloud):
        few = len(part.xyz_m) < _FEWEST_POINTS
        return () if few else (part.xyz_m.tobytes(), part.range_rate_mps.tobytes())
    return (part,)

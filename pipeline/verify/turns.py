"""Known turns applied to a shipped calibration, to find those that are called wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry.sensor_turns import TURN_AXES, sensor_turn
from pipeline.verify.one_axis import AxisCheck

__all__ = ["Turn", "turns_of_log"]


@dataclass(frozen=True)
class Turn:
    """A turn of one sensor about an axis of its own; `kind` is the kind of pair whose limits apply."""

    sensor: str
    kind: str
    axis: str
    deg: float

    @property
    def name(self) -> str:
        """Name of the turn: sensor, axis and degrees."""
        return f"{self.sensor} {self.axis} {self.deg:+g}"

    def transform(self) -> Float[np.ndarray, "4 4"]:
        """The turn as T_sensor_turned: from axes of the turned sensor to axes of the sensor."""
        return sensor_turn(self.axis, float(np.radians(self.deg)), of_camera=self.kind == "camera_lidar")


def turns_of_log(
    checks: Sequence[AxisCheck], sizes: Sequence[float], count: int, identity: str
) -> list[Turn]:
    """Turns for a log: sizes, axes and sensors alternate over the logs of a set; a log has both signs of a turn.

    Args:
        checks: checks of the calibration as shipped.
        sizes: sizes of the turns, as multiples of the error that must be detected.
        count: number of turns.
        identity: hexadecimal identity of the log, which determines the first of its turns in the list of all.
    """
    every = [
        Turn(c.pair, c.kind, axis, sign * round(float(np.degrees(c.asked_rad)) * size, 6))
        for size in sizes
        for axis in TURN_AXES
        for c in sorted(checks, key=lambda c: c.pair)
        if c.axis == axis
        for sign in (1.0, -1.0)
    ]
    first = 2 * (int(identity, 16) % max(len(every) // 2, 1))
    return [every[(first + k) % len(every)] for k in range(min(count, len(every)))]

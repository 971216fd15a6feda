"""When sensors without a common trigger measure: each at its own rate and phase."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

__all__ = ["Clocks", "Ticks", "free_clocks"]

# Of a rate against its nominal value: mechanical lidars hold theirs to some parts in a thousand, quartzes to a hundred
# in a million. Without it 30 and 10 Hz would keep one gap for a whole drive, as if they were triggered.
_RATE_SD: Final = (1e-4, 3e-3, 1e-4)


@dataclass(frozen=True)
class Ticks:
    """The stamps of one sensor: phase + k period [s]."""

    period_s: float
    phase_s: float

    def nearest(self, t_s: float) -> tuple[float, float]:
        """The stamp nearest to a time, and the next nearest."""
        k = round((t_s - self.phase_s) / self.period_s)
        first = self.phase_s + k * self.period_s
        return first, first + float(np.copysign(self.period_s, t_s - first))


@dataclass(frozen=True)
class Clocks:
    """Stamps of the three sensors during one drive."""

    camera: Ticks
    lidar: Ticks
    radar: Ticks


def free_clocks(rates_hz: tuple[float, float, float], rng: np.random.Generator) -> Clocks:
    """Clocks of camera, lidar and radar that know nothing of each other.

    Args:
        rates_hz: nominal rates of the three.
        rng: draws phases and what the rates are off by.
    """
    periods = 1 / (np.array(rates_hz) * (1 + rng.normal(0, _RATE_SD)))
    phases = rng.uniform(0, periods)
    return Clocks(*(Ticks(float(p), float(a)) for p, a in zip(periods, phases, strict=True)))

"""Stamps of sensors without a common trigger: each with its own rate and phase."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from pipeline.simulate.sensors.rig_spec import RigSpec

__all__ = ["Ticks", "free_clocks"]

# Relative rate errors: mechanical lidars keep theirs to some parts in a thousand, quartzes to a hundred in a
# million. Without them, 30 and 10 Hz would keep a constant gap for a whole drive, as if triggered.
_RATE_SD: Final = {"camera": 1e-4, "lidar": 3e-3, "radar": 1e-4}


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


def free_clocks(rig: RigSpec, rng: np.random.Generator) -> dict[str, Ticks]:
    """Independent clocks of the free-running sensors for one drive: random phases and rate errors."""
    free = {s.name: (s.rate_hz, _RATE_SD[s.kind]) for s in rig.sensors if s.rate_hz is not None}
    rates, sd = np.array([*free.values()]).reshape(-1, 2).T
    periods = 1 / (rates * (1 + rng.normal(0, sd)))
    phases = rng.uniform(0, periods)
    return {n: Ticks(float(p), float(a)) for n, p, a in zip(free, periods, phases, strict=True)}

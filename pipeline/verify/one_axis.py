"""Status of one axis from its distance, sigma and held-out frames; and which errors would have failed.

An error fails if it is measured (beyond so many sigmas, and beyond its limit) and if held-out frames confirm
the log's answer: a record many sigmas from its prior is held where they align no better than at the prior.
Turns of the answer show whether they would (`calibrate/judging.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr, ndtri

from pipeline.core.config import ChecksConfig

__all__ = ["AxisCheck", "AxisLimits", "HeldOut", "checked", "power_of", "shown_from"]

# The smallest detectable error of a log would have failed with this probability.
SHOWN_POWER = 0.95
_SHOWN_SIGMAS = float(ndtri(SHOWN_POWER))
# Scatter of z between a turn of the log's answer and a calibration in use that is off by the same turn. Most likely
# .3 to .4 by 22 turns of the real car's day, wider (.8) with 25 of its four logs alone: these were rather caught
# where little was promised.
_Z_SCATTER = 0.3


@dataclass(frozen=True)
class AxisLimits:
    """Limits of one axis: error that makes a calibration wrong, and error that must be detected [rad].

    For a pass, an error of `asked_rad` would have failed with probability `confidence`.
    """

    limit_rad: float
    asked_rad: float
    confidence: float


@dataclass(frozen=True)
class HeldOut:
    """Held-out test of known turns of a log's answer; empty if none was made.

    Args:
        z: deviate of the paired test by turn [deg], negative = they prefer the answer.
        better_z: from -z on they confirm it.
        agreement: answers within so many sigmas of the calibration in use need no confirmation.
    """

    z: Mapping[float, float] = field(default_factory=dict)
    better_z: float = ChecksConfig().better_alignment_z
    agreement: float = ChecksConfig().prior_agreement_sigmas

    def confirms(self, deg: float) -> float:
        """Probability that they confirm the answer against an error of this size, either sign equally likely."""
        found = []
        for sign in (1, -1):
            own = {0.0: 0.0} | {abs(d): z for d, z in self.z.items() if d * sign > 0}
            sizes = sorted(own)
            if len(sizes) > 1:
                z = np.interp(deg, sizes, [own[s] for s in sizes])
                found.append(float(ndtr((-self.better_z - z) / _Z_SCATTER)))
        return float(np.mean(found)) if found else 1.0


@dataclass(frozen=True)
class AxisCheck:
    """Result of one axis of one pair; angles [rad] are nan if the log gives no estimate.

    `pair` is the kind of the pair, or the names of its sensors if they differ from their kinds; for a rig of
    many sensors, the name of the sensor. `off_rad` is positive where targets lie too far left or up, or are
    turned clockwise, in the axes of the first of `sensors`.
    """

    pair: str
    kind: str
    sensors: tuple[str, ...]
    axis: str
    status: str  # pass, warn, fail or inconclusive
    reason: str
    off_rad: float
    sigma_rad: float
    limit_rad: float
    asked_rad: float
    power: float  # probability that an error of `asked_rad` would have failed
    shown_rad: (
        float  # from here on errors would have failed with probability SHOWN_POWER; nan = none of those tried
    )


def power_of(
    size_rad: float, limit_rad: float, sigma_rad: float, beyond: float, held_out: HeldOut | None = None
) -> float:
    """Probability that an error of this size would have failed: measured, and confirmed where it is far off."""
    held_out = held_out or HeldOut()
    threshold = max(limit_rad, beyond * sigma_rad)
    measured = float(ndtr((size_rad - threshold) / sigma_rad))
    far = float(ndtr((size_rad - max(threshold, held_out.agreement * sigma_rad)) / sigma_rad))
    return measured - far * (1 - held_out.confirms(float(np.degrees(size_rad))))


def shown_from(limit_rad: float, sigma_rad: float, beyond: float, held_out: HeldOut | None = None) -> float:
    """Size from which on errors would have failed with probability SHOWN_POWER, up to the largest that was tried."""
    held_out = held_out or HeldOut()
    tried = np.radians(sorted({abs(deg) for deg in held_out.z}))
    least = max(limit_rad, beyond * sigma_rad) + _SHOWN_SIGMAS * sigma_rad
    shown = float("nan") if len(tried) and tried[-1] >= least else least
    for size in [*[s for s in tried[::-1] if s > least], least]:
        if power_of(size, limit_rad, sigma_rad, beyond, held_out) < SHOWN_POWER - 1e-9:
            break
        shown = float(size)
    return shown


def checked(
    of: tuple[str, str, tuple[str, ...]], axis: str, limits: AxisLimits, off: tuple[float, float],
    blocked: str, beyond: float, held_out: HeldOut | None = None,
) -> AxisCheck:  # fmt: skip
    """Check one axis.

    Args:
        of: the pair or sensor in words, its kind, and the sensors.
        axis: azimuth, elevation or roll.
        limits: of the axis.
        off: signed distance and its sigma; nan if the log has no estimate.
        blocked: why the log's answer cannot be compared; empty if it can.
        beyond: threshold in sigmas.
        held_out: the held-out test of turns.
    """
    held_out = held_out or HeldOut()
    power = 0.0 if blocked else power_of(limits.asked_rad, limits.limit_rad, off[1], beyond, held_out)
    shown = shown_from(limits.limit_rad, off[1], beyond, held_out)
    status = ("inconclusive", blocked) if blocked else _status(off, limits, power, beyond, held_out)
    return AxisCheck(*of, axis, *status, *off, limits.limit_rad, limits.asked_rad, power, shown)


def _status(
    off: tuple[float, float], limits: AxisLimits, power: float, beyond: float, held_out: HeldOut
) -> tuple[str, str]:
    distance = f"{_deg(off[0])} off, sigma {_deg(off[1])}"
    is_measured = abs(off[0]) > beyond * off[1]
    if is_measured and abs(off[0]) > limits.limit_rad:
        return "fail", f"{distance}, limit {_deg(limits.limit_rad)}"
    if power < limits.confidence:
        asked = _deg(limits.asked_rad)
        why = f"it would detect an error of {asked} with a probability of only {power:.0%}"
        if held_out.confirms(float(np.degrees(limits.asked_rad))) < limits.confidence:
            why = f"held-out frames align as well with an error of {asked}"
        return "inconclusive", f"{distance}. This log cannot prove it: {why}"
    if is_measured:
        return "warn", f"{distance}: significant, but within the limit of {_deg(limits.limit_rad)}"
    return "pass", distance


def _deg(angle_rad: float) -> str:
    return f"{np.degrees(abs(angle_rad)):.2f} deg"

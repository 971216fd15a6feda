"""Independent sources of radar pitch: the pitch from each alone, and a larger sigma if they are inconsistent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.part_turn import PartTurn

__all__ = ["Contradiction", "contradiction", "doubted", "own_equations", "own_numbers"]

_SIGMAS = 2.0  # from which two sources contradict each other
_SINGULAR = 1e-9


@dataclass(frozen=True)
class Contradiction:
    """Sources of pitch that differ by more than their sigmas allow."""

    factor: float  # to add to their combined sigma of pitch
    sentence: str


def own_equations(
    name: str, H: Float[np.ndarray, "P P"], g: Float[np.ndarray, " P"], floor_rad: float
) -> PartTurn | None:
    """Pitch correction from these equations alone, with sigma; None if pitch is unconstrained.

    Pitch is the first unknown, the others are nuisances; `floor_rad` is the sigma of errors common to all
    frames.
    """
    scale = np.sqrt(np.maximum(np.diag(H), _SINGULAR))
    if H[0, 0] <= _SINGULAR or np.linalg.eigvalsh(H / np.outer(scale, scale))[0] < _SINGULAR:
        return None
    covariance = np.linalg.inv(H)
    return PartTurn(name, float(-(covariance @ g)[0]), float(np.sqrt(covariance[0, 0])), floor_rad)


def doubted(sources: Sequence[PartTurn]) -> dict[str, float]:
    """Sigmas [rad] to add to sources of pitch that are biased by detections measured too low.

    Such detections rotate the estimated radar upwards. `heights` models them. If another source gives a
    higher pitch than both sigmas allow, its difference from `heights` is taken as its error.
    """
    right = next((w for w in sources if w.name == "heights"), None)
    if right is None:
        return {}
    apart = {w: w.offset_rad - right.offset_rad for w in sources if w is not right}
    beyond = {w.name: a**2 - w.sigma_rad**2 - right.sigma_rad**2 for w, a in apart.items() if a < 0}
    return {name: float(np.sqrt(variance)) for name, variance in beyond.items() if variance > 0}


def contradiction(sources: Sequence[PartTurn]) -> Contradiction | None:
    """Sources that are inconsistent with the mean of the others, and the factor on pitch's sigma; None if all agree.

    The factor is the square root of chi-squared per degree of freedom, at least one.

    Source: Birge 1932, "The calculation of errors by the method of least squares".
    """
    apart = [w for w in sources if _is_contradicted(w, [o for o in sources if o is not w])]
    if not apart:
        return None
    mean, _ = _mean(sources)
    chi2 = sum(((w.offset_rad - mean) / w.sigma_rad) ** 2 for w in sources)
    factor = max(1.0, float(np.sqrt(chi2 / (len(sources) - 1))))
    said = ", ".join(
        f"{w.name} {np.degrees(w.offset_rad):+.2f} +- {np.degrees(w.sigma_rad):.2f} deg" for w in sources
    )
    sentence = (
        f"sources of radar pitch contradict each other ({said}): its sigma is {factor:.1f} times as wide"
    )
    return Contradiction(factor, sentence)


def own_numbers(sources: Sequence[PartTurn]) -> dict[str, float]:
    """Offset and sigma of each source, for the diagnostics of a record."""
    numbers: dict[str, float] = {}
    for w in sources:
        numbers |= {
            f"{w.name}_pitch_offset_rad": w.offset_rad,
            f"{w.name}_pitch_sigma_rad": w.sigma_rad,
        }
    return numbers


def _is_contradicted(source: PartTurn, others: Sequence[PartTurn]) -> bool:
    if not others:
        return False
    mean, sigma = _mean(others)
    return bool(abs(source.offset_rad - mean) > _SIGMAS * np.hypot(source.sigma_rad, sigma))


def _mean(sources: Sequence[PartTurn]) -> tuple[float, float]:
    """Weighted mean and its sigma."""
    weight = np.array([w.sigma_rad**-2 for w in sources])
    offset = np.array([w.offset_rad for w in sources])
    return float(weight @ offset / weight.sum()), float(weight.sum() ** -0.5)

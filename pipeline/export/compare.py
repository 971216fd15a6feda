"""Difference of two calibrations per axis, and whether their sigmas explain it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from pipeline.export.calibration import ExportedPair
from pipeline.export.tree import ESTIMATED_PAIRS
from pipeline.rig.graph import EDGE_OF_PAIR, edge_order
from pipeline.rig.se3 import change_between, change_covariance, inverse, log_se3
from pipeline.rig.targets import PairDifference, target_sigmas

__all__ = ["Side", "compare", "composed"]


@dataclass(frozen=True, eq=False)
class Side:
    """One of the two calibrations.

    Args:
        vehicle: id; empty if a file does not contain it.
        days: days of its data; empty if a file does not contain them.
        missing: reason for each missing pair, by name.
    """

    title: str
    pairs: Mapping[str, ExportedPair]
    vehicle: str = ""
    days: frozenset[str] = frozenset()
    missing: Mapping[str, str] = field(default_factory=dict)


def compare(a: Side, b: Side) -> tuple[list[PairDifference], list[str]]:
    """Change from A to B of each pair that both have, and remarks on the sigmas, in sentences.

    For different days of one vehicle, the common part of the covariance cancels in the difference. It is left
    out of the sigma if both sides state it. Otherwise the sigmas are those of independent estimates.
    """
    apart = bool(a.vehicle) and a.vehicle == b.vehicle and bool(a.days and b.days) and not a.days & b.days
    found, lacks_common = [], False
    both = [pair for pair in a.pairs if pair in b.pairs]
    for pair in sorted(both, key=lambda pair: edge_order(a.pairs[pair].edge)):
        one, other = a.pairs[pair], b.pairs[pair]
        common = apart and one.common is not None and other.common is not None
        lacks_common |= apart and not common
        covariances = [_covariance(p, without_common=common) for p in (one, other)]
        stated = [c for c in covariances if c is not None]
        xi = log_se3(other.T @ inverse(one.T))
        found.append(
            PairDifference(
                one.edge,
                (one.status, other.status),
                change_between(one.T, other.T),
                np.sqrt(np.diag(sum(stated, np.zeros((6, 6))))) if stated else None,
                np.array(one.observable) & np.array(other.observable),
                target_sigmas(one.edge.kind, one.T, np.outer(xi, xi)),
            )
        )
    return found, _notes(a, b, apart=apart, lacks_common=lacks_common)


def composed(pairs: Mapping[str, ExportedPair]) -> dict[str, ExportedPair]:
    """Add the third pair, composed of two, with unknown covariance."""
    found = dict(pairs)
    if "camera_radar" not in found and all(p in found for p in ESTIMATED_PAIRS):
        first, second = (found[p] for p in ESTIMATED_PAIRS)
        found["camera_radar"] = ExportedPair(
            EDGE_OF_PAIR["camera_radar"], first.T @ second.T, status=first.status
        )
    return found


def _covariance(pair: ExportedPair, *, without_common: bool) -> Float[np.ndarray, "6 6"] | None:
    """Covariance of (rotation vector, origin) of an estimate, as needed for a difference."""
    if pair.covariance is None:
        return None
    full = change_covariance(pair.T, pair.covariance)
    if not without_common or pair.common is None:
        return full
    varying = change_covariance(pair.T, pair.covariance - pair.common)
    # Sigmas are estimates too: as in the state, the relative scatter of a day's sigma is at least a tenth.
    floor = 0.01 * np.diag(full)
    return varying + np.diag(np.maximum(floor - np.diag(varying), 0.0))


def _notes(a: Side, b: Side, *, apart: bool, lacks_common: bool) -> list[str]:
    notes = [f"{side.title}: no {pair}: {why}" for side in (a, b) for pair, why in side.missing.items()]
    if a.vehicle and b.vehicle and a.vehicle != b.vehicle:
        notes.append("Two vehicles: their mountings differ by more than the sigmas.")
    elif a.days & b.days:
        notes.append(
            "Both use the same days: their errors are not independent, and the true sigma may be smaller."
        )
    elif apart:
        words = "Different days of one vehicle: the sigmas leave out the error common to all days"
        notes.append(f"{words}{', where the records state it' if lacks_common else ''}.")
    if any(p.status == "prior" for side in (a, b) for p in side.pairs.values()):
        notes.append(
            "A record depends on its prior: axes that the day did not determine change less than the sigmas suggest."
        )
    exact = [s.title for s in (a, b) if s.pairs and all(p.covariance is None for p in s.pairs.values())]
    return [*notes, *(f"{title} states no sigma and is treated as exact." for title in exact)]

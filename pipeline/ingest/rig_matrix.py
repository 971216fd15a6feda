"""A rig as a matrix of sensor pairs: common field of view, common moments, and the DoF that they can give."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from pipeline.ingest.readiness import DofVerdict
from pipeline.rig.graph import Edge, RigGraph, possible_edges
from pipeline.rig.overlap import Overlap

__all__ = ["PairFinding", "RigFinding", "dof_counts", "rig_finding"]

_COUNTED: Final = ("roll", "pitch", "yaw", "x", "y", "z")


@dataclass(frozen=True)
class PairFinding:
    """One pair of sensors.

    Args:
        share: common share of the smaller field of view, at the prior; None if unknown, and for base.
        moments: number with both sensors; for base, number with the sensor.
    """

    parent: str
    child: str
    kind: str
    share: float | None
    moments: int
    is_edge: bool
    why_not: str = ""
    verdicts: list[DofVerdict] = field(default_factory=list)


@dataclass(frozen=True)
class RigFinding:
    """The rig: kinds by sensor, the reference of the poses, all possible edges, and unconnected sensors."""

    sensors: dict[str, str]
    reference: str
    pairs: list[PairFinding]
    loose: list[str]


def rig_finding(
    graph: RigGraph,
    overlaps: Sequence[Overlap],
    moments: Sequence[Collection[str]],
    verdicts: Mapping[Edge, list[DofVerdict]],
) -> RigFinding:
    """Matrix of a rig: `moments` has the sensors with data of each moment."""
    seen = {o.edge: o for o in overlaps}
    pairs = []
    for edge in possible_edges(graph.sensors):
        is_edge, share = edge in graph.edges, seen[edge].share if edge in seen else None
        ends = {s.name for s in edge.sensors if s.kind != "base"}
        both = sum(ends <= set(moment) for moment in moments)
        why_not = "" if is_edge else _why_not(edge, seen.get(edge), moments)
        own = list(verdicts.get(edge, ()))
        pairs.append(
            PairFinding(edge.parent.name, edge.child.name, edge.kind, share, both, is_edge, why_not, own)
        )
    tied = graph.components()[0]
    loose = [s.name for s in graph.sensors if s not in tied]
    return RigFinding({s.name: s.kind for s in graph.sensors}, graph.reference.name, pairs, loose)


def dof_counts(verdicts: Sequence[DofVerdict]) -> tuple[int, int]:
    """Number of DoF of the six that an edge gives, and number that depend partly on the prior."""
    counts = dict.fromkeys(("yes", "weak", "no"), 0)
    for verdict in verdicts:
        words = verdict.dof.replace("translation", "x y z").replace(",", " ").split()
        counts[verdict.verdict] += sum(word in _COUNTED for word in words)
    return counts["yes"], counts["weak"]


def _why_not(edge: Edge, overlap: Overlap | None, moments: Sequence[Collection[str]]) -> str:
    silent = [s.name for s in edge.sensors if s.kind != "base" and not any(s.name in m for m in moments)]
    if silent:
        return f"no data of {' and '.join(silent)}"
    if overlap is None:
        return "no prior" if edge.child.kind != "base" else "not named"
    return "others share more" if overlap.is_enough else "their fields of view do not overlap"

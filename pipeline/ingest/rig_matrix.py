"""A rig as a matrix, sensor by sensor: what each two see in common, how often, and which DoF that can give."""

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
    """What two sensors can say of each other.

    Args:
        parent: a sensor.
        child: another, or base.
        kind: of their edge, e.g. camera_lidar.
        share: of the directions of the one that sees fewer, at the prior; None where nobody knows, and to base.
        moments: that have both; to base, that have the sensor.
        is_edge: whether they are calibrated against each other.
        why_not: they are not.
        verdicts: of each class of DoF, of an edge.
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
    """The rig: kinds by sensor, which one poses refer to, all that could be edges, and what nothing ties to it."""

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
    """The matrix of a rig.

    Args:
        graph: with the edges that are calibrated.
        overlaps: of sensors with data and a prior.
        moments: sensors that have data, of each moment.
        verdicts: of the graph's edges.
    """
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
    """How many of the six DoF an edge gives, and how many of which the prior carries part."""
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
    return "others share more" if overlap.is_enough else "they see nothing in common"

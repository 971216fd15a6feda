"""Sensors of a rig, edges that can be calibrated between them, graph queries, edges and poses in table columns.

The graph has names only, no transforms or arrays. A sensor has a unique name and a kind; `base` is the
vehicle frame, a node without data. An edge joins two nodes with a shared view; kinds are in the order camera,
lidar, radar, base.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final, Literal, cast, get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float, Int

from pipeline.rig.kinds import EDGE_KINDS
from pipeline.rig.se3 import from_quaternion, to_quaternion
from schemas.calibrations import FRAMES_OF_PAIR, CalibrationRecord
from schemas.columns import POSE_COLUMNS
from schemas.drift import DriftFinding
from schemas.states import StateRow

__all__ = [
    "BASE", "EDGE_KINDS", "EDGE_OF_PAIR", "KINDS", "POSE", "TIE_KINDS", "Edge", "Kind", "RigGraph", "Sensor",
    "edge_between", "edge_named", "edge_of", "edge_order", "edges_of_rows", "is_one_of_each", "pose_columns",
    "pose_of", "possible_edges", "tie", "words_of",
]  # fmt: skip

Kind = Literal["camera", "lidar", "radar", "base"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
# Kinds of two nodes connected through other nodes: their relative pose follows from the adjustment of the
# rig.
TIE_KINDS: Final = (*EDGE_KINDS, "camera_camera", "radar_radar")


@dataclass(frozen=True, order=True)
class Sensor:
    """A node of the rig; its name is unique for all kinds together; base is the vehicle frame."""

    name: str
    kind: Kind

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"{self.name}: unknown kind of sensor {self.kind!r}")


BASE: Final = Sensor("base", "base")


@dataclass(frozen=True, order=True)
class Edge:
    """Two nodes with an estimated T_parent_child: calibrated directly, or through other nodes (`tie`)."""

    parent: Sensor
    child: Sensor

    def __post_init__(self) -> None:
        if self.parent.name == self.child.name:
            raise ValueError(f"an edge joins two sensors, not {self.parent.name} and itself")
        if self.kind not in TIE_KINDS:
            raise ValueError(_no_edge(self.parent, self.child))

    @property
    def kind(self) -> str:
        """Kinds of both sensors, e.g. camera_lidar; column `pair` of records."""
        return f"{self.parent.kind}_{self.child.kind}"

    @property
    def name(self) -> str:
        """Names of both sensors, e.g. front-top."""
        return f"{self.parent.name}-{self.child.name}"

    @property
    def sensors(self) -> tuple[Sensor, Sensor]:
        """Parent and child."""
        return self.parent, self.child

    def other(self, name: str) -> Sensor:
        """The sensor at the other end of the named one."""
        return self.child if name == self.parent.name else self.parent


def possible_edges(nodes: Sequence[Sensor]) -> tuple[Edge, ...]:
    """All edges between nodes whose kinds can be calibrated against each other."""
    pairs = (sorted(two, key=lambda s: KINDS.index(s.kind)) for two in combinations(nodes, 2))
    return tuple(edge_between(a, b) for a, b in pairs if f"{a.kind}_{b.kind}" in EDGE_KINDS)


def edge_between(a: Sensor, b: Sensor) -> Edge:
    """The edge between two sensors in any order; ValueError if their kinds have no calibration."""
    found = tie(a, b)
    if found.kind not in EDGE_KINDS:
        raise ValueError(_no_edge(*found.sensors))
    return found


def tie(a: Sensor, b: Sensor) -> Edge:
    """An edge between two different nodes of any kinds and in any order, for relative poses of any method."""
    return Edge(*sorted((a, b), key=lambda s: (KINDS.index(s.kind), s.name)))


def is_one_of_each(sensors: Collection[Sensor]) -> bool:
    """True for at most one camera, one lidar and one radar, and no vehicle frame: records are per pair."""
    return BASE not in sensors and len({s.kind for s in sensors}) == len(sensors)


def _no_edge(a: Sensor, b: Sensor) -> str:
    return (
        f"{a.name} ({a.kind}) and {b.name} ({b.kind}) cannot be calibrated against each other: edges are of kinds "
        f"{', '.join(EDGE_KINDS)}"
    )


@dataclass(frozen=True)
class RigGraph:
    """Sensors, edges and the reference sensor of the poses.

    Args:
        edges: between sensors of the rig, each once.

    Raises:
        ValueError: a duplicate name, a duplicate edge, or an edge or reference with a sensor outside the rig.
    """

    sensors: tuple[Sensor, ...]
    edges: tuple[Edge, ...]
    reference: Sensor

    def __post_init__(self) -> None:
        names = [s.name for s in self.sensors]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"two sensors are called {', '.join(twice)}")
        if self.reference not in self.sensors:
            raise ValueError(f"the reference {self.reference.name} is no sensor of the rig")
        ends = [frozenset(e.sensors) for e in self.edges]
        for edge, end in zip(self.edges, ends, strict=True):
            unknown = sorted(s.name for s in end if s not in self.sensors)
            if unknown:
                raise ValueError(f"edge {edge.name}: the rig has no {', '.join(unknown)}")
            if ends.count(end) > 1:
                raise ValueError(f"edge {edge.name} occurs twice")

    def __getitem__(self, name: str) -> Sensor:
        """The sensor with this name; raises KeyError if there is none."""
        found = [s for s in self.sensors if s.name == name]
        if not found:
            raise KeyError(name)
        return found[0]

    def of_kind(self, *kinds: Kind) -> tuple[Sensor, ...]:
        """Sensors of these kinds, in the rig's order."""
        return tuple(s for s in self.sensors if s.kind in kinds)

    def edges_of(self, sensor: Sensor) -> tuple[Edge, ...]:
        """Edges with this sensor at one end."""
        return tuple(e for e in self.edges if sensor in e.sensors)

    def with_edges(self, edges: Collection[Edge]) -> RigGraph:
        """A graph of the same sensors with other edges."""
        return RigGraph(self.sensors, tuple(edges), self.reference)

    def without(self, edges: Collection[Edge]) -> RigGraph:
        """The graph without some edges."""
        return self.with_edges([e for e in self.edges if e not in edges])

    def components(self) -> tuple[tuple[Sensor, ...], ...]:
        """Connected sensors, the reference's component first, then in the rig's order."""
        found: list[tuple[Sensor, ...]] = []
        for start in (self.reference, *self.sensors):
            if not any(start in c for c in found):
                tied = self._tied_to(start)
                found.append(tuple(s for s in self.sensors if s in tied))
        return tuple(found)

    def path(self, a: Sensor, b: Sensor) -> tuple[Edge, ...] | None:
        """A shortest path of edges from a to b; empty if a is b, None if no path connects them."""
        if a == b:
            return ()
        came: Mapping[Sensor, tuple[Edge, ...]] = {a: ()}
        seen = dict(came)
        queue = [a]
        while queue:
            here = queue.pop(0)
            for edge in self.edges_of(here):
                there = edge.other(here.name)
                if there not in seen:
                    seen[there] = (*seen[here], edge)
                    queue.append(there)
        return seen.get(b)

    def cycles(self) -> tuple[tuple[Edge, ...], ...]:
        """A cycle basis: each edge outside a spanning tree, and the path between its ends in the tree."""
        tree, rest = self._spanning_tree()
        grown = self.with_edges(tree)
        return tuple((edge, *(grown.path(*edge.sensors) or ())) for edge in rest)

    def _tied_to(self, start: Sensor) -> set[Sensor]:
        tied, grew = {start}, True
        while grew:
            more = {s for e in self.edges for s in e.sensors if set(e.sensors) & tied} - tied
            tied |= more
            grew = bool(more)
        return tied

    def _spanning_tree(self) -> tuple[Sequence[Edge], Sequence[Edge]]:
        """Edges of a spanning tree of each component, and the other edges, both in the rig's order."""
        tree: list[Edge] = []
        for edge in self.edges:
            if self.with_edges(tree).path(*edge.sensors) is None:
                tree.append(edge)
        return tree, [e for e in self.edges if e not in tree]


POSE: Final = "pose"  # in column `pair` of rows about a sensor's pose
_COLUMNS: Final = ("pair", "parent_frame", "child_frame")


def edge_named(pair: str, parent: str, child: str) -> Edge:
    """The edge of kind `pair` between two sensors; ValueError if the kind is unknown or the names equal."""
    if pair not in EDGE_KINDS:
        raise ValueError(f"no edge is of the kind {pair!r}: there are {', '.join(EDGE_KINDS)}")
    kinds = [cast("Kind", kind) for kind in pair.split("_")]
    return Edge(Sensor(parent, kinds[0]), Sensor(child, kinds[1]))


def edge_of(row: CalibrationRecord | StateRow | DriftFinding) -> Edge:
    """The edge of a record."""
    return edge_named(row.pair, row.parent_frame, row.child_frame)


# Edges of a rig whose sensors are named after their kinds, as in a short fleet.toml.
EDGE_OF_PAIR: Final[Mapping[str, Edge]] = {
    pair: edge_named(pair, *frames) for pair, frames in FRAMES_OF_PAIR.items()
}


def edge_order(edge: Edge) -> tuple[int, str, str]:
    """Sort key of an edge: kinds in the order of TIE_KINDS, then names."""
    return TIE_KINDS.index(edge.kind), edge.parent.name, edge.child.name


def words_of(edge: Edge) -> str:
    """Text for an edge: its kind if its sensors are named after their kinds, else their names."""
    return edge.kind if edge == EDGE_OF_PAIR.get(edge.kind) else edge.name


def edges_of_rows(rows: pa.Table) -> tuple[tuple[Edge, ...], Int[np.ndarray, " N"]]:
    """Unique sorted edges of rows (pair, parent_frame, child_frame), and each row's edge, or -1."""
    names = [pc.fill_null(rows[name], "").combine_chunks() for name in _COLUMNS]
    coded = pc.binary_join_element_wise(*names, "\0").dictionary_encode()
    found = [_edge_or_none(*text.split("\0")) for text in coded.dictionary.to_pylist()]
    edges = tuple(sorted({edge for edge in found if edge is not None}, key=edge_order))
    place = np.array([-1 if edge is None else edges.index(edge) for edge in found], np.int64)
    return edges, place[np.asarray(coded.indices)]


def _edge_or_none(pair: str, parent: str, child: str) -> Edge | None:
    try:
        return edge_named(pair, parent, child)
    except ValueError:
        return None


def pose_columns(T: Float[np.ndarray, "4 4"] | None, prefix: str = "") -> dict[str, Any]:
    """Columns of a pose, their names with a prefix; all null without a pose."""
    values = [None] * 7 if T is None else [float(v) for v in (*to_quaternion(T), *T[:3, 3])]
    return {f"{prefix}{name}": value for name, value in zip(POSE_COLUMNS, values, strict=True)}


def pose_of(column: Callable[[str], Any], prefix: str = "") -> Float[np.ndarray, "4 4"] | None:
    """The pose in the columns of a prefix, each given by its name; None if one is null."""
    values = [column(prefix + name) for name in POSE_COLUMNS]
    return None if None in values else from_quaternion(np.array(values[:4]), np.array(values[4:]))

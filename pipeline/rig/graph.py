"""Sensors of a rig, the edges that can be calibrated between them, and the questions asked of that graph.

Names only: no transform, no array. A sensor has a name of its own and a kind; `base` is the vehicle frame, a node
without data. An edge joins two nodes that see the same; kinds stand in the order camera, lidar, radar, base.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, Literal, get_args

__all__ = [
    "BASE",
    "EDGE_KINDS",
    "KINDS",
    "TIE_KINDS",
    "Edge",
    "Kind",
    "RigGraph",
    "Sensor",
    "edge_between",
    "is_one_of_each",
    "possible_edges",
    "tie",
]

Kind = Literal["camera", "lidar", "radar", "base"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
# Kinds of two nodes that can be calibrated against each other; two cameras meet through a lidar.
EDGE_KINDS: Final = (
    "camera_lidar", "camera_radar", "lidar_radar", "lidar_lidar", "lidar_base", "radar_base",
)  # fmt: skip
# Also of two nodes that others tie to each other: where one is to the reference follows from a rig that was adjusted.
TIE_KINDS: Final = (*EDGE_KINDS, "camera_camera", "radar_radar", "camera_base")


@dataclass(frozen=True, order=True)
class Sensor:
    """A node of the rig.

    Args:
        name: unique in the rig, whatever the kind.
        kind: camera, lidar, radar, or base for the vehicle frame.
    """

    name: str
    kind: Kind

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"{self.name}: no kind of sensor is called {self.kind!r}")


BASE: Final = Sensor("base", "base")


@dataclass(frozen=True, order=True)
class Edge:
    """Two nodes of which T_parent_child is known: calibrated against each other, or by way of others (`tie`).

    Raises:
        ValueError: a sensor and itself; both in the wrong order.
    """

    parent: Sensor
    child: Sensor

    def __post_init__(self) -> None:
        if self.parent.name == self.child.name:
            raise ValueError(f"an edge joins two sensors, not {self.parent.name} and itself")
        if self.kind not in TIE_KINDS:
            raise ValueError(_no_edge(self.parent, self.child))

    @property
    def kind(self) -> str:
        """Kinds of both sensors, e.g. camera_lidar; what a record calls its pair."""
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
    """All edges that the nodes' kinds allow."""
    pairs = (sorted(two, key=lambda s: KINDS.index(s.kind)) for two in combinations(nodes, 2))
    return tuple(edge_between(a, b) for a, b in pairs if f"{a.kind}_{b.kind}" in EDGE_KINDS)


def edge_between(a: Sensor, b: Sensor) -> Edge:
    """The edge of two sensors, whichever is given first.

    Raises:
        ValueError: they cannot be calibrated against each other.
    """
    found = tie(a, b)
    if found.kind not in EDGE_KINDS:
        raise ValueError(_no_edge(*found.sensors))
    return found


def tie(a: Sensor, b: Sensor) -> Edge:
    """Two nodes of any kinds as an edge, whichever is given first: what a rig's pose is known by, not how.

    Raises:
        ValueError: a sensor and itself.
    """
    return Edge(*sorted((a, b), key=lambda s: (KINDS.index(s.kind), s.name)))


def is_one_of_each(sensors: Collection[Sensor]) -> bool:
    """At most one camera, one lidar and one radar, and no vehicle frame: a rig whose records are of adjusted poses."""
    return BASE not in sensors and len({s.kind for s in sensors}) == len(sensors)


def _no_edge(a: Sensor, b: Sensor) -> str:
    return (
        f"{a.name} ({a.kind}) and {b.name} ({b.kind}) cannot be calibrated against each other: edges are of kinds "
        f"{', '.join(EDGE_KINDS)}"
    )


@dataclass(frozen=True)
class RigGraph:
    """Sensors, edges and the sensor that poses refer to.

    Args:
        sensors: by unique names.
        edges: between sensors of the rig, each once.
        reference: one of the sensors.

    Raises:
        ValueError: a name twice, an edge twice, an edge or a reference that is not of the rig.
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
                raise ValueError(f"edge {edge.name} stands twice")

    def __getitem__(self, name: str) -> Sensor:
        """The sensor of that name; KeyError where there is none."""
        found = [s for s in self.sensors if s.name == name]
        if not found:
            raise KeyError(name)
        return found[0]

    def of_kind(self, *kinds: Kind) -> tuple[Sensor, ...]:
        """Sensors of these kinds, in the rig's order."""
        return tuple(s for s in self.sensors if s.kind in kinds)

    def edges_of(self, sensor: Sensor) -> tuple[Edge, ...]:
        """Edges that the sensor is an end of."""
        return tuple(e for e in self.edges if sensor in e.sensors)

    def with_edges(self, edges: Collection[Edge]) -> RigGraph:
        """The same sensors with other edges."""
        return RigGraph(self.sensors, tuple(edges), self.reference)

    def without(self, edges: Collection[Edge]) -> RigGraph:
        """The graph less some edges."""
        return self.with_edges([e for e in self.edges if e not in edges])

    def components(self) -> tuple[tuple[Sensor, ...], ...]:
        """Sensors that edges tie together, the reference's first, then by the rig's order."""
        found: list[tuple[Sensor, ...]] = []
        for start in (self.reference, *self.sensors):
            if not any(start in c for c in found):
                tied = self._tied_to(start)
                found.append(tuple(s for s in self.sensors if s in tied))
        return tuple(found)

    def path(self, a: Sensor, b: Sensor) -> tuple[Edge, ...] | None:
        """A shortest way of edges from a to b; empty where they are one, None where nothing ties them."""
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

    def is_on_cycle(self, edge: Edge) -> bool:
        """Whether its sensors are tied without it: only then does anything else check it."""
        return self.without([edge]).path(*edge.sensors) is not None

    def cycles(self) -> tuple[tuple[Edge, ...], ...]:
        """A basis: each edge outside a spanning tree, with the shortest way between its ends in the tree."""
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
        """Edges of a tree in each component, and the others, both in the rig's order."""
        tree: list[Edge] = []
        for edge in self.edges:
            if self.with_edges(tree).path(*edge.sensors) is None:
                tree.append(edge)
        return tree, [e for e in self.edges if e not in tree]

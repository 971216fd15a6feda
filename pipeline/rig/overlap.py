"""Which sensors see the same, and so which edges a rig has: found from their views at the prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry.se3 import exp_so3, inverse, transform_points
from pipeline.rig.graph import Edge, RigGraph, Sensor, edge_between, possible_edges
from pipeline.rig.prior import RigPrior
from pipeline.rig.views import View

__all__ = ["Overlap", "best_three", "find_edges", "overlaps_of"]

_RANGES_M = (15.0, 25.0, 40.0)  # of the targets that pairs are certified at
_LEAST = 0.05  # of the directions of the sensor that sees fewer
# Edges that each sensor keeps, whichever cut is clearer: more add cost, and sigma falls with the root of their number.
# What two sensors share differs by 1 to 5 % from day to day (eight days of a van), and charts need the same edges.
_BEST = (3, 4)
_DIRECTIONS = 10_000  # about 2 deg apart, as fine as a view's borders are known


@dataclass(frozen=True)
class Overlap:
    """How much two sensors see in common.

    Args:
        edge: between them.
        share: of the directions of the one that sees fewer, mean over 15, 25 and 40 m.
        shared_sr: solid angle that they share.
    """

    edge: Edge
    share: float
    shared_sr: float

    @property
    def is_enough(self) -> bool:
        """Whether that makes an edge."""
        return self.share >= _LEAST


def overlaps_of(prior: RigPrior, views: Mapping[str, View]) -> tuple[Overlap, ...]:
    """Of each two sensors that could be calibrated against each other; a sensor without a view shares nothing.

    Within a sigma of the prior views count as overlapping: it is the prior that may be off.
    """
    own = {s: _sphere()[views[s.name](_sphere())] for s in prior.nodes if s.name in views}
    found = []
    for edge in possible_edges([s for s, seen in own.items() if len(seen)]):
        a, b = edge.sensors
        T_a_b = prior.between(a.name, b.name)
        if T_a_b is not None:
            few, many, T = (b, a, T_a_b) if len(own[b]) <= len(own[a]) else (a, b, inverse(T_a_b))
            sigmas = prior.sigmas_between(a.name, b.name)
            seen = [_seen(r * own[few], T, views[many.name], sigmas, r).mean() for r in _RANGES_M]
            share = float(np.mean(seen))
            found.append(Overlap(edge, share, share * len(own[few]) / _DIRECTIONS * 4 * np.pi))
    return tuple(found)


def find_edges(
    prior: RigPrior,
    overlaps: Sequence[Overlap],
    *,
    named: Sequence[Edge] | None = None,
    reference: Sensor | None = None,
) -> RigGraph:
    """The rig's graph: edges that it names, or those of sensors that see the same.

    Each sensor keeps its three or four best edges by what they share, and those that a tree needs which ties all that
    can be tied. Where the rig has `base`, every lidar and every radar has an edge to it. What nothing ties to the
    reference is in another of the graph's components. A rig with one sensor of each kind has all pairs as edges.

    Args:
        prior: of the rig, which knows its nodes.
        overlaps: of its sensors.
        named: edges of fleet.toml; they are all that the graph has.
        reference: sensor of fleet.toml; None = the lidar with most edges, of a rig without one the radar.
    """
    found = _of_overlaps(prior.nodes, overlaps)
    base = [edge for edge in possible_edges(prior.nodes) if edge.child.kind == "base"]
    edges = (*found, *base) if named is None else tuple(named)
    return RigGraph(prior.nodes, edges, reference or _most_tied(prior.nodes, edges))


def best_three(overlaps: Sequence[Overlap]) -> tuple[Sensor, Sensor, Sensor] | None:
    """Camera, lidar and radar of which all three pairs share a view, the most by the pair that shares least."""
    shared = {o.edge: o.shared_sr for o in overlaps if o.is_enough}
    sensors = dict.fromkeys(s for edge in shared for s in edge.sensors)
    by_kind = [[s for s in sensors if s.kind == kind] for kind in ("camera", "lidar", "radar")]
    triples = {
        (c, l, r): min(shared.get(edge_between(*pair), 0.0) for pair in ((c, l), (l, r), (c, r)))
        for c, l, r in product(*by_kind)
    }
    best = max(triples, key=lambda triple: triples[triple], default=None)
    return best if best is not None and triples[best] > 0 else None


def _of_overlaps(nodes: Sequence[Sensor], overlaps: Sequence[Overlap]) -> list[Edge]:
    """Best edges of each sensor and a tree, in the order of the overlaps."""
    sensors = [n for n in nodes if n.kind != "base"]
    if len({s.kind for s in sensors}) == len(sensors):
        return [edge_between(a, b) for a, b in combinations(sensors, 2)]
    best_first = sorted((o for o in overlaps if o.is_enough), key=lambda o: -o.shared_sr)
    kept: set[Edge] = set()
    for sensor in sensors:
        own = [o for o in best_first if sensor in o.edge.sensors]
        kept |= {o.edge for o in own[: max(_BEST, key=lambda best: _clearness(own, best))]}
    tied = {s: i for i, s in enumerate(sensors)}
    for edge in (o.edge for o in best_first):
        a, b = (tied[s] for s in edge.sensors)
        if a != b:
            kept.add(edge)
            tied = {s: a if group == b else group for s, group in tied.items()}
    return [o.edge for o in overlaps if o.edge in kept]


def _clearness(best_first: Sequence[Overlap], best: int) -> float:
    """How much more the last of so many edges shares than the next one does, or than an edge has to."""
    if best > len(best_first):
        return 0.0
    last = best_first[best - 1]
    return last.share / _LEAST if best == len(best_first) else last.shared_sr / best_first[best].shared_sr


def _most_tied(nodes: Sequence[Sensor], edges: Sequence[Edge]) -> Sensor:
    """Of lidars, else radars, else cameras, the first of those with most edges."""
    kind = next(k for k in ("lidar", "radar", "camera") if any(n.kind == k for n in nodes))
    return max((n for n in nodes if n.kind == kind), key=lambda n: sum(n in e.sensors for e in edges))


def _seen(
    points: Float[np.ndarray, "N 3"],
    T_view_points: Float[np.ndarray, "4 4"],
    view: View,
    sigmas: tuple[float, float],
    range_m: float,
) -> Bool[np.ndarray, " N"]:
    """Points that are in view, or come into it where the prior is off by a sigma in some direction."""
    margin = float(np.hypot(sigmas[0], sigmas[1] / range_m))
    there = transform_points(T_view_points, points)
    seen = view(there)
    for axis, sign in product(np.eye(3), (-1.0, 1.0)):
        seen |= view(there @ exp_so3(sign * margin * axis).T)
    return seen


def _sphere() -> Float[np.ndarray, "N 3"]:
    """Directions evenly over the sphere (Fibonacci's spiral)."""
    k = np.arange(_DIRECTIONS) + 0.5
    z, azimuth = 1 - 2 * k / _DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], -1)

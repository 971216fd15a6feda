"""Pairs of sensors with overlapping views at the prior, and the edges of a rig from them.

A view is the image area of a camera (CameraInfo), or the directions with points of a lidar or radar. Gaps
due to the scene are filled. A radar without elevation has no limits in elevation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from jaxtyping import Bool, Float

from pipeline.rig.cameras import Camera
from pipeline.rig.graph import Edge, RigGraph, Sensor, edge_between, possible_edges
from pipeline.rig.prior import RigPrior
from pipeline.rig.se3 import exp_so3, inverse, to_spherical, transform_points

__all__ = [
    "FRAMES", "Overlap", "View", "best_three", "find_edges", "overlaps_of", "view_of_camera",
    "view_of_clouds",
]  # fmt: skip

_RANGES_M = (15.0, 25.0, 40.0)  # target ranges at which pairs are certified
_LEAST = 0.05  # minimum overlap, as share of the smaller view
# Number of edges per sensor, three or four, at the clearer cut. More edges add cost; sigma falls with the
# square root of their number. Overlaps differ by 1 to 5 % from day to day (eight days of a van), and charts
# need the same edges.
_BEST = (3, 4)
_DIRECTIONS = 10_000  # about 2 deg apart, the resolution of a view's borders
# Mask of the points in a sensor's frame that it can see.
View = Callable[[Float[np.ndarray, "*batch 3"]], Bool[np.ndarray, "*batch"]]
FRAMES = 20  # per day, enough for the borders of a view
_POINTS = 2000  # per frame
_BIN_RAD = np.radians(2.0)
_FEWEST = 100  # minimum number of points for a view
# Share of the median point density; directions below it are outside the view. De-skewing spreads the border
# of a sweep over ten degrees at highway speeds, with a lower density than this.
_DENSE = 0.25
_STRAY = 0.002  # share of points that may lie above a view, and below it
# A wider gap between directions with points is the end of the view; a view has at most one.
_HOLE_RAD = np.radians(20.0)


@dataclass(frozen=True)
class Overlap:
    """Solid angle of the overlap of two sensors; its share of the smaller view, mean of 15, 25, 40 m."""

    edge: Edge
    share: float
    shared_sr: float

    @property
    def is_enough(self) -> bool:
        """True if the overlap is large enough for an edge."""
        return self.share >= _LEAST


def overlaps_of(prior: RigPrior, views: Mapping[str, View]) -> tuple[Overlap, ...]:
    """Overlaps of all pairs of sensors that could be calibrated; a sensor without a view has no overlap.

    Views within one sigma of the prior count as overlapping, because the prior may be wrong by that much.
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
    """The graph of the rig: edges from fleet.toml, or edges between sensors with overlapping views.

    Each sensor keeps the three or four edges with the largest overlap, plus the edges of a spanning tree. If
    the rig has `base`, every sensor has an edge to it. Sensors that no edge connects to the
    reference form other components of the graph. A rig with one sensor of each kind has all pairs as edges.

    Args:
        named: edges from fleet.toml; if given, the graph has only these.
        reference: reference sensor from fleet.toml; None = the lidar with most edges, or a radar in a rig
            without lidar.
    """
    found = _of_overlaps(prior.nodes, overlaps)
    base = [edge for edge in possible_edges(prior.nodes) if edge.child.kind == "base"]
    edges = (*found, *base) if named is None else tuple(named)
    return RigGraph(prior.nodes, edges, reference or _most_tied(prior.nodes, edges))


def best_three(overlaps: Sequence[Overlap]) -> tuple[Sensor, Sensor, Sensor] | None:
    """Camera, lidar and radar that maximise the smallest of their three overlaps; None without such."""
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
    """Edges with the largest overlap per sensor plus a spanning tree, in the order of the overlaps."""
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
    """Ratio of the overlap of the last of `best` edges to that of the next one (or to the minimum)."""
    if best > len(best_first):
        return 0.0
    last = best_first[best - 1]
    return last.share / _LEAST if best == len(best_first) else last.shared_sr / best_first[best].shared_sr


def _most_tied(nodes: Sequence[Sensor], edges: Sequence[Edge]) -> Sensor:
    """The first lidar with the most edges; without lidars the first such radar, then the first such camera."""
    kind = next(k for k in ("lidar", "radar", "camera") if any(n.kind == k for n in nodes))
    return max((n for n in nodes if n.kind == kind), key=lambda n: sum(n in e.sensors for e in edges))


def _seen(
    points: Float[np.ndarray, "N 3"],
    T_view_points: Float[np.ndarray, "4 4"],
    view: View,
    sigmas: tuple[float, float],
    range_m: float,
) -> Bool[np.ndarray, " N"]:
    """True for points in view, also if the prior is wrong by one sigma in any direction."""
    margin = float(np.hypot(sigmas[0], sigmas[1] / range_m))
    there = transform_points(T_view_points, points)
    seen = view(there)
    for axis, sign in product(np.eye(3), (-1.0, 1.0)):
        seen |= view(there @ exp_so3(sign * margin * axis).T)
    return seen


def _sphere() -> Float[np.ndarray, "N 3"]:
    """Directions evenly over the sphere (Fibonacci spiral)."""
    k = np.arange(_DIRECTIONS) + 0.5
    z, azimuth = 1 - 2 * k / _DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], -1)


def view_of_camera(camera: Camera) -> View:
    """Mask of points that project into the image."""

    def seen(points: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch"]:
        uv, valid = camera.project(points)
        return valid & camera.contains(np.where(np.isfinite(uv), uv, -1.0))

    return seen


def view_of_clouds(clouds: Sequence[Float[np.ndarray, "_ 3"]]) -> View | None:
    """View of a lidar or radar from sweeps or scans over its day [m]; None if there are too few points."""
    if sum(len(c) for c in clouds) < _FEWEST:
        return None
    return _of_points(np.concatenate([c[:: max(len(c) // _POINTS, 1)] for c in clouds]).astype(np.float64))


def _of_points(points: Float[np.ndarray, "N 3"]) -> View:
    """Azimuths outside the widest gap, lowest to highest elevation (no limits if all points are level)."""
    azimuth, elevation = to_spherical(points)[:, :2].T
    bins = round(2 * np.pi / _BIN_RAD)
    count = np.bincount(_bin(azimuth, bins), minlength=bins)
    filled = _without_holes(count > _DENSE * np.sum(count**2) / len(points))
    low, high = np.quantile(elevation, [_STRAY, 1 - _STRAY])
    flat = high - low < 1e-6

    def seen(at: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch"]:
        az, el, _ = np.moveaxis(to_spherical(at), -1, 0)
        return filled[_bin(az, bins)] & (flat | ((el >= low) & (el <= high)))

    return seen


def _without_holes(filled: Bool[np.ndarray, " B"]) -> Bool[np.ndarray, " B"]:
    """Bins of a circle with all gaps filled, except the widest unless it is due to the scene."""
    at = np.flatnonzero(filled)
    if not len(at):
        return np.ones_like(filled)
    gaps = np.diff(at, append=at[0] + len(filled)) - 1
    widest = int(np.argmax(gaps))
    out = np.ones_like(filled)
    if gaps[widest] * _BIN_RAD > _HOLE_RAD:
        out[(at[widest] + 1 + np.arange(gaps[widest])) % len(filled)] = False
    return out


def _bin(azimuth: np.ndarray, bins: int) -> np.ndarray:
    return np.asarray((azimuth + np.pi) / _BIN_RAD, np.int64) % bins

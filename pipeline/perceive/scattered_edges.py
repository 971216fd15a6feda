"""Depth jumps of a sweep without rows: between each point and its nearest neighbours to the four sides.

A silhouette is between two neighbours if the nearer one belongs to a standing object and the farther one does
not belong to it. A neighbour counts as left if its vertical distance is at most half of its horizontal one.
All neighbours behind the silhouette determine its side: at a post's left edge, the beam above may miss the
post too, but this is not an upper edge.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int32
from scipy.spatial import cKDTree

from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT

__all__ = ["Jumps", "jumps_between_neighbours"]

_NEIGHBOURS: Final = 16  # of a random pattern these reach about 2.3 mean spacings far
# Median distances to the nearest point; beyond, something did not return in between.
_REACH_STEPS: Final = 4.0
_ASIDE: Final = 0.5  # a neighbour to one side lies at most this much of its distance to another
# Axis of (azimuth, elevation) and sign towards the background: azimuth grows to the left, and a foreground that ends
# at its left lies right of its silhouette.
_SIDES: Final = ((EDGE_RIGHT, 0, 1.0), (EDGE_LEFT, 0, -1.0), (EDGE_BELOW, 1, 1.0), (EDGE_ABOVE, 1, -1.0))


class Jumps(NamedTuple):
    """Jumps of one side: expected silhouette (azimuth, elevation, range), and their points."""

    at_aer: Float[np.ndarray, "E 3"]
    side: int
    jump_m: Float[np.ndarray, " E"]
    gap_rad: Float[np.ndarray, " E"]
    foreground: Int[np.ndarray, " E"]


class _Neighbours(NamedTuple):
    """The nearest other points of each point, and (azimuth, elevation) [rad] to them."""

    point: np.ndarray
    offset_rad: np.ndarray
    reachable: np.ndarray


def jumps_between_neighbours(
    aer: Float[np.ndarray, "N 3"],
    cluster: Int32[np.ndarray, " N"],
    edge_jump_m: float,
    edge_jump_fraction: float,
) -> list[Jumps]:
    """Jumps in range from clustered points to neighbours that are not of their cluster.

    `aer` is azimuth, elevation [rad] and range [m]. Unclustered points make no edges: neighbours differ in
    elevation, so even the ground has jumps. A jump must exceed `edge_jump_m`, and `edge_jump_fraction` of the
    nearer range.
    """
    if len(aer) <= _NEIGHBOURS:
        return []
    near = _neighbours(aer[:, :2])
    range_m = aer[:, 2]
    least = np.maximum(edge_jump_m, edge_jump_fraction * range_m)
    is_behind = (range_m[near.point] - range_m[:, None] > least[:, None]) & (
        cluster[near.point] != cluster[:, None]
    )
    towards = _towards(near, is_behind)
    found = []
    for side, axis, sign in _SIDES:
        there, seen = _nearest_to(near, axis, sign)
        before, opposite = _nearest_to(near, axis, -sign)
        faces = sign * towards[:, axis] > np.abs(towards[:, 1 - axis])
        jump = range_m[there] - range_m
        is_edge = seen & faces & (cluster >= 0) & (cluster[there] != cluster) & (jump > least)
        # A beam that hits two surfaces returns a point between them: in front of it the silhouette comes earlier.
        is_edge &= ~(opposite & (range_m - range_m[before] > least[before]))
        here = np.flatnonzero(is_edge)
        middle = (aer[here, :2] + aer[there[here], :2]) / 2
        gap = np.abs(aer[there[here], axis] - aer[here, axis])
        found.append(Jumps(np.column_stack([middle, range_m[here]]), side, jump[here], gap, here))
    return found


def _towards(near: _Neighbours, chosen: Bool[np.ndarray, "N K"]) -> Float[np.ndarray, "N 2"]:
    """Sum of the directions to some neighbours: towards the background, across the silhouette."""
    distance = np.maximum(np.linalg.norm(near.offset_rad, axis=-1, keepdims=True), 1e-9)
    return np.sum(near.offset_rad / distance * (chosen & near.reachable)[..., None], axis=1)


def _neighbours(directions: Float[np.ndarray, "N 2"]) -> _Neighbours:
    distance, index = cKDTree(directions).query(directions, k=_NEIGHBOURS + 1)
    distance, index = distance[:, 1:], index[:, 1:]
    step = float(np.median(distance[:, 0]))
    return _Neighbours(index, directions[index] - directions[:, None], distance < _REACH_STEPS * step)


def _nearest_to(
    near: _Neighbours, axis: int, sign: float
) -> tuple[Int[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """The neighbour to one side of each point, and whether it has one."""
    along, aside = sign * near.offset_rad[..., axis], np.abs(near.offset_rad[..., 1 - axis])
    fits = near.reachable & (along > 0) & (aside <= _ASIDE * along)
    nearest = np.argmin(np.where(fits, along, np.inf), axis=1)
    rows = np.arange(len(along))
    return near.point[rows, nearest], fits[rows, nearest]

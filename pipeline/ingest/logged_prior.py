"""Prior poses of a rig's sensors from its logs: transforms between the frame ids of its messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.ingest.index import DayIndex
from pipeline.rig.graph import BASE, Sensor
from pipeline.rig.prior import Star, between, middle_of, star_of, to_rows
from pipeline.rig.rig import Rig

__all__ = ["LoggedPrior"]


class LoggedPrior:
    """Collects the transforms between sensors, log by log; from a prior file if the rig names one."""

    def __init__(self, index: DayIndex, rig: Rig, given: Star | None) -> None:
        self._index, self._rig, self._given = index, rig, given
        self._found: dict[tuple[int, tuple[str, str], tuple[str, str]], np.ndarray | None] = {}
        self._stars: dict[tuple[int, tuple[tuple[str, str], ...]], tuple[Star, bool]] = {}
        self._untied: set[tuple[str, str]] = set()
        self.frame_ids: dict[str, list[str]] = {}

    def take(self, log: int, ids: Mapping[str, str]) -> bool:
        """Look up the poses of a moment's sensors by frame id; returns whether all of them are connected."""
        key = (log, tuple(ids.items()))
        if key not in self._stars:
            for sensor, frame_id in ids.items():
                if frame_id not in self.frame_ids.setdefault(sensor, []):
                    self.frame_ids[sensor].append(frame_id)
            frames = dict(ids) if self._rig.base is None else {**ids, BASE.name: self._rig.base}
            nodes = [node for node in self._rig.nodes if node.name in frames]
            star = self._given
            if star is None:
                star = star_of(nodes, lambda a, b: self._lookup(log, (a, frames[a]), (b, frames[b])))
            self._stars[key] = star, _is_tied([node for node in nodes if node != BASE], star)
        return self._stars[key][1]

    def rows(self) -> list[dict[str, Any]]:
        """Rows for the manifest: each transform of each log once, in the layout of `schemas.moments.PRIOR`."""
        rows = {}
        for (log, _), (star, _) in self._stars.items():
            for row in to_rows([star]):
                name = self._index.log_names[log]
                rows[name, row["parent"], row["child"], *row["q"], *row["t_m"]] = {"log": name, **row}
        return list(rows.values())

    def frames_above(self) -> list[dict[str, Any]]:
        """The frames between each sensor's frame and the root of the car's tree, as rows of T_parent_child."""
        chains: dict[tuple[str, str], np.ndarray] = {}
        for log in {key[0] for key in self._stars}:
            tree = self._index.trees[log]
            parent_of = tree.edges
            for frame in {name.lstrip("/") for ids in self.frame_ids.values() for name in ids}:
                child = frame
                while (parent := parent_of.get(child)) is not None and (parent, child) not in chains:
                    T = tree.lookup(parent, child)
                    assert T is not None, "an edge of the tree"
                    chains[parent, child] = T
                    child = parent
        return to_rows([chains])

    def _lookup(self, log: int, a: tuple[str, str], b: tuple[str, str]) -> np.ndarray | None:
        """T_a_b of two sensors with their frames."""
        if (log, a, b) not in self._found:
            T = self._index.trees[log].lookup(a[1], b[1])
            self._found[log, a, b] = T
            # Report each sensor once: if several have no chain, no two of them are connected.
            if T is None and not {a, b} <= self._untied:
                self._untied |= {a, b}
                names = f"{a[1] or '(no frame id)'} to {b[1] or '(no frame id)'}"
                self._index.complain(f"{self._rig.prior.topic} has no chain from {names}: no prior")
        return self._found[log, a, b]


def _is_tied(nodes: list[Sensor], star: Star) -> bool:
    middle = middle_of(nodes)
    return all(between(star, middle.name, node.name) is not None for node in nodes)

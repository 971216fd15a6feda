"""Edges and poses in table columns: the pair (kind of the edge) and the names of its two sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float, Int

from pipeline.rig.graph import TIE_KINDS, Edge, Kind, Sensor
from pipeline.rig.kinds import EDGE_KINDS
from pipeline.rig.se3 import from_quaternion, to_quaternion
from schemas.calibrations import FRAMES_OF_PAIR, CalibrationRecord
from schemas.columns import POSE_COLUMNS
from schemas.drift import DriftFinding
from schemas.states import StateRow

__all__ = [
    "EDGE_OF_PAIR",
    "POSE",
    "edge_named",
    "edge_of",
    "edge_order",
    "edges_of_rows",
    "pose_columns",
    "pose_of",
    "words_of",
]

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

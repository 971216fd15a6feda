"""Model lines in words: what their vehicles share, and which of them differ."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.geometry.changes import changed
from pipeline.rig.edges import line_edge, words_of
from pipeline.rig.graph import Edge
from pipeline.rig.sigmas import direction_sigmas
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake
from pipeline.store.records import read_last
from schemas.columns import POSE_COLUMNS
from schemas.fleet_model import FLEET_MODEL, LINE_ANSWERS, LINE_STATUSES, FleetModelRow, LineAnswer

__all__ = [
    "AnswerView",
    "FleetLines",
    "LineView",
    "answer_cells",
    "fleet_lines",
    "last_answers",
    "scatter_words",
    "shared_words",
    "too_few",
]

_DEG = 180 / math.pi
_NAMED = 12  # vehicles that a page names; the others it counts
_OF_ANSWERS = ("line", "kinds", "reason", "distance_sigmas", "differs")
_BOTH = (
    "line", "kinds", "status", "reason", *POSE_COLUMNS, "covariance", "alone_covariance", "moved_by", "record_day",
    "record_change", "record_covariance", "record_alone_covariance",
)  # fmt: skip


@dataclass(frozen=True)
class LineView:
    """One edge of a model line, as a row of the fleet page."""

    line: str
    edge: str
    status: str
    vehicles: int
    scatter: str
    shared: tuple[str, ...]
    outside: tuple[str, ...]
    reason: str


@dataclass(frozen=True)
class AnswerView:
    """A vehicle that differs from its line."""

    vehicle: str
    line: str
    edge: str
    reason: str


@dataclass(frozen=True)
class FleetLines:
    """Lines of the last night, the most urgent first.

    Args:
        lines: those with enough vehicles.
        too_few: vehicles of the others, by name.
        differ: vehicles that differ from their line, the first ones.
        differing: how many do.
        both: cells of the vehicles that were asked for, alone and with their line.
    """

    lines: list[LineView] = field(default_factory=list)
    too_few: dict[str, int] = field(default_factory=dict)
    differ: list[AnswerView] = field(default_factory=list)
    differing: int = 0
    both: list[dict[str, str]] = field(default_factory=list)


def too_few(rows: Iterable[FleetModelRow]) -> dict[str, int]:
    """Vehicles of the lines that have no edge with enough of them, by name."""
    most: dict[str, int] = {}
    enough = set()
    for r in rows:
        most[r.line] = max(most.get(r.line, 0), r.vehicles)
        if r.mean is not None:
            enough.add(r.line)
    return {line: count for line, count in sorted(most.items()) if line not in enough}


def last_answers(lake: Lake, method: str, vehicles: Iterable[str]) -> list[LineAnswer]:
    """Answers of some vehicles on the last night, for `answer_cells`."""
    among = frozenset(vehicles)
    return read_last(lake, LINE_ANSWERS, LineAnswer, method, vehicle=among, columns=_BOTH) if among else []


def answer_cells(answer: LineAnswer, *, of_day: bool) -> dict[str, str] | None:
    """Cells by their headings: an answer alone and with its line; None where the line has no answer.

    Args:
        of_day: the answer of its last day, in place of all days since the last change.
    """
    T, edge = transform_of(answer), line_edge(answer)
    alone, with_line, moved = answer.alone_covariance, answer.covariance, answer.moved_by
    if T is None or answer.status == "alone":
        return None
    if of_day:
        alone, with_line = answer.record_alone_covariance, answer.record_covariance
        T = None if answer.record_change is None else changed(T, np.asarray(answer.record_change))
    if T is None or alone is None or with_line is None or moved is None:
        return None
    cells = {"edge": words_of(edge), "alone (1 sigma)": _known_to(edge, T, alone)}
    cells |= {"with its line (1 sigma)": _known_to(edge, T, with_line)}
    if not of_day:
        turn, shift = np.linalg.norm(moved[:3]) * _DEG, np.linalg.norm(moved[3:])
        cells |= {"the line moves it by": f"{turn:.2f} deg, {shift:.3f} m"}
    said = "as alone" if answer.status == "outside" else ""
    return cells | {"reason": ": ".join(text for text in (said, answer.reason) if text)}


def _known_to(edge: Edge, T: np.ndarray, covariance: np.ndarray) -> str:
    azimuth, elevation = direction_sigmas(edge, T, np.asarray(covariance)) * _DEG
    return f"azimuth {azimuth:.3f}, elevation {elevation:.3f} deg"


def fleet_lines(lake: Lake, method: str, shown: Iterable[str] = ()) -> FleetLines:
    """Lines of the last night as the fleet page shows them; `shown`: vehicles that are shown alone and with theirs."""
    rows = read_last(lake, FLEET_MODEL, FleetModelRow, method)
    if not rows:
        return FleetLines()
    few = too_few(rows)
    known = [r for r in rows if r.line not in few]
    ordered = sorted(known, key=lambda r: (LINE_STATUSES.index(r.status), r.line))
    lines = [
        LineView(
            r.line, _edge_of(r), r.status, r.vehicles, scatter_words(r.scatter), tuple(shared_words(vars(r))),
            tuple(r.outside[:_NAMED]), r.reason,
        )
        for r in ordered
    ]  # fmt: skip
    differ = [r for r in read_last(lake, LINE_ANSWERS, LineAnswer, method, columns=_OF_ANSWERS) if r.differs]
    differ.sort(key=lambda r: -(r.distance_sigmas or 0.0))
    views = [AnswerView(r.vehicle, r.line, _edge_of(r), r.reason) for r in differ[:_NAMED]]
    both = [
        {"vehicle": answer.vehicle} | cells
        for answer in last_answers(lake, method, shown)
        for cells in [answer_cells(answer, of_day=False)]
        if cells is not None
    ]
    return FleetLines(lines, few, views, len(differ), both)


def scatter_words(scatter: Sequence[float] | None) -> str:
    """Scatter of a line's mounts (1 sigma) by axis; - where it is not known."""
    if scatter is None:
        return ""
    turns = " ".join("-" if math.isnan(s) else f"{s * _DEG:.2f}" for s in scatter[:3])
    shifts = " ".join("-" if math.isnan(s) else f"{s:.3f}" for s in scatter[3:])
    return f"{turns} deg, {shifts} m"


def shared_words(row: Mapping[str, Any]) -> list[str]:
    """Errors that all vehicles of a line have in common, with one sigma, and of what they are."""
    words = []
    for name, total in row["totals"].items():
        told = name in (row["told_apart"] or ())
        value, sigma = (
            (row["shared_errors"][name], row["shared_error_sigmas"][name])
            if told
            else (total, row["total_sigmas"][name])
        )
        size = (
            f"{value:+.3f} +- {sigma:.3f} m"
            if name.endswith("range")
            else f"{value * _DEG:+.2f} +- {sigma * _DEG:.2f} deg"
        )
        words.append(f"{name} {size}{'' if told else ', or all mounts by as much'}")
    return words + _clock_words(row)


def _clock_words(row: Mapping[str, Any]) -> list[str]:
    """Time offset of the vehicles, a step of it, and who differs."""
    if row["clock_mean_s"] is None:
        return []
    of = f"stamps of {row['parent_frame']} minus {row['child_frame']}"
    size = f"{row['clock_mean_s']:+.4f} +- {row['clock_sigma_s']:.4f} s"
    words = [f"{of} {size}, vehicles scatter by {row['clock_scatter_s']:.4f} s"]
    if row["clock_step_s"] is not None:
        step = f"{row['clock_step_s']:+.4f} +- {row['clock_step_sigma_s']:.4f} s"
        words.append(f"they stepped by {step} in the last 3 days, as with a software release")
    if row["clock_outside"]:
        names, more = row["clock_outside"][:_NAMED], len(row["clock_outside"]) - _NAMED
        words.append(f"they differ on {', '.join(names)}{f' and {more} more' if more > 0 else ''}")
    return words


def _edge_of(row: FleetModelRow | LineAnswer) -> str:
    return words_of(line_edge(row))

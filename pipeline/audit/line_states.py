"""States beside their answers with the model line, and in their place where fleet.toml asks for it."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from pipeline.rig.edges import edge_named
from pipeline.rig.graph import Edge
from pipeline.store.partitions import Lake
from pipeline.store.records import last_assertion, read_last
from schemas.fleet_model import LINE_ANSWERS, LineAnswer
from schemas.states import StateRow

__all__ = ["answers_of", "with_its_line"]

_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")


def answers_of(lake: Lake, method: str, day: str) -> dict[tuple[str, Edge], LineAnswer]:
    """Tonight's answers by vehicle and edge; empty where the last ones are of another day."""
    last = last_assertion(lake, LINE_ANSWERS, method)
    if last is None or last.day != day:
        return {}
    rows = read_last(lake, LINE_ANSWERS, LineAnswer, method)
    return {(r.vehicle, edge_named(r.pair, r.parent_frame, r.child_frame)): r for r in rows}


def with_its_line(state: StateRow, answer: LineAnswer | None, use: Literal["report", "states"]) -> StateRow:
    """A state with the answer of its line beside it, or in its place if it is to be loaded and the line has a part."""
    if answer is None:
        return state
    beside = replace(
        state,
        line_status=answer.status,
        line_reason=answer.reason,
        line_covariance=answer.covariance,
        line_azimuth_sigma_rad=answer.azimuth_sigma_rad,
        line_elevation_sigma_rad=answer.elevation_sigma_rad,
        line_moved_by=answer.moved_by,
        **{f"line_{name}": getattr(answer, name) for name in _POSE},
    )
    if use != "states" or answer.status != "shared":
        return beside
    if state.status == "none" and not answer.determined:
        return beside  # no day was accepted, and with the line neither axis is within its limit
    line = f"with {answer.line}, its model line"
    none = "no day of the vehicle alone was accepted" if state.status == "none" else ""
    return replace(
        beside,
        **{name: getattr(answer, name) for name in _POSE},
        **{f"alone_{name}": getattr(state, name) for name in _POSE},
        alone_covariance=state.covariance,
        loads="line",
        status="current",
        reason="; ".join(text for text in (line, none, state.reason if not none else "") if text),
        covariance=answer.covariance,
        common_covariance=answer.common_covariance,
        observable=[True] * 6 if state.observable is None else state.observable,
        determined=answer.determined,
        azimuth_sigma_rad=answer.azimuth_sigma_rad,
        elevation_sigma_rad=answer.elevation_sigma_rad,
        days=state.days or [answer.record_day or answer.day],
    )

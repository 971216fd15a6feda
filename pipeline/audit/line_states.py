"""States beside their answers with the model line, and in their place where fleet.toml asks for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from pipeline.audit.line_records import release_of
from pipeline.rig.edges import line_edge
from pipeline.rig.graph import Edge
from pipeline.store.partitions import Lake
from pipeline.store.records import last_assertion, read_last
from schemas.columns import POSE_COLUMNS
from schemas.fleet_model import LINE_ANSWERS, LineAnswer
from schemas.states import StateRow
from schemas.versions import CODE_VERSION

__all__ = ["LineAnswers", "answers_of", "with_its_line"]


@dataclass(frozen=True, eq=False)
class LineAnswers:
    """The last answers with a line, by vehicle and edge or pose; none where `refused` says why they are not used."""

    of: Mapping[tuple[str, Edge], LineAnswer]
    refused: str = ""


def answers_of(lake: Lake, method: str, day: str) -> LineAnswers:
    """Answers of a night. Those of another day or release are refused: the vehicle may have changed since."""
    last = last_assertion(lake, LINE_ANSWERS, method)
    if last is None:
        return LineAnswers({}, "no model line was learnt yet")
    if last.day != day:
        return LineAnswers(
            {}, f"model lines were learnt for {last.day}, not for {day}; run the audit of that day"
        )
    rows = read_last(lake, LINE_ANSWERS, LineAnswer, method)
    of_others = sorted(
        {r.code_version for r in rows if release_of(r.code_version) != release_of(CODE_VERSION)}
    )
    if of_others:
        why = f"model lines were learnt by boresight {', '.join(of_others)}, not by {CODE_VERSION}; run the audit again"
        return LineAnswers({}, why)
    return LineAnswers({(r.vehicle, line_edge(r)): r for r in rows})


def with_its_line(
    state: StateRow, edge: Edge, answers: LineAnswers, use: Literal["report", "states"]
) -> StateRow:
    """A state with the answer of its line beside it, or in its place if it is to be loaded and the line has a part."""
    answer = answers.of.get((state.vehicle, edge))
    if answers.refused and use == "states":
        reason = "; ".join(
            text for text in (state.reason, f"loads the vehicle alone: {answers.refused}") if text
        )
        return replace(state, line_status="alone", line_reason=answers.refused, reason=reason)
    if answer is None:
        if use != "states":
            return state
        why = "no day of it counts in a model line"
        return replace(
            state, line_status="alone", line_reason=why, reason="; ".join(filter(None, (state.reason, why)))
        )
    beside = replace(
        state,
        line_status=answer.status,
        line_reason=answer.reason,
        line_covariance=answer.covariance,
        line_azimuth_sigma_rad=answer.azimuth_sigma_rad,
        line_elevation_sigma_rad=answer.elevation_sigma_rad,
        line_moved_by=answer.moved_by,
        **{f"line_{name}": getattr(answer, name) for name in POSE_COLUMNS},
    )
    if use != "states" or answer.status != "shared":
        return beside
    if state.status == "none" and not answer.determined:
        return beside  # no day was accepted, and with the line neither axis is within its limit
    line = f"with {answer.line}, its model line"
    none = "no day of the vehicle alone was accepted" if state.status == "none" else ""
    return replace(
        beside,
        **{name: getattr(answer, name) for name in POSE_COLUMNS},
        **{f"alone_{name}": getattr(state, name) for name in POSE_COLUMNS},
        alone_covariance=state.covariance,
        loads="line",
        status="current",
        reason="; ".join(text for text in (line, none, state.reason if not none else "") if text),
        covariance=answer.covariance,
        common_covariance=answer.common_covariance,
        observable=answer.observable if state.observable is None else state.observable,
        determined=answer.determined,
        azimuth_sigma_rad=answer.azimuth_sigma_rad,
        elevation_sigma_rad=answer.elevation_sigma_rad,
        days=state.days or [answer.record_day or answer.day],
    )

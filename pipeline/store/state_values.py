"""States as commands and pages show them: columns, transforms, and one line on what of them is used and certified."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from pipeline.rig.edges import pose_of
from schemas.states import STATES, StateRow
from schemas.words import AXIS_NAMES, axes_in_words

__all__ = ["state_values"]


def state_values(states: Sequence[StateRow]) -> list[dict[str, Any]]:
    """Each state as a dict of its columns, with "T", "T_prior" (4x4 or None) and "in_words"."""
    kinds = {(s.vehicle, s.method, s.sensor): s.kind for s in states if s.sensor is not None}
    return [
        {c.name: getattr(s, c.name) for c in STATES.columns}
        | {
            "T": pose_of(partial(getattr, s)),
            "T_prior": pose_of(partial(getattr, s), "prior_"),
            "in_words": _in_words(s, kinds.get((s.vehicle, s.method, s.parent_frame))),
        }
        for s in states
    ]


def _in_words(state: StateRow, parent_kind: str | None) -> str:
    if state.observable is None or state.sensor == state.parent_frame:
        return ""
    kind = parent_kind if parent_kind in AXIS_NAMES else state.pair.partition("_")[0]
    return axes_in_words(kind if kind in AXIS_NAMES else "lidar", state.observable, state.determined)

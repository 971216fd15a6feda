"""What the page about the calibration in use says first: the answer in a sentence, and a line per axis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["AxisRow", "InUseView", "in_use_view"]

_MOODS = {"pass": "good", "warn": "partly", "fail": "bad", "inconclusive": "none"}
_ANSWERS = {
    "right": ("good", "Yes, as far as it matters"),
    "wrong": ("bad", "No"),
    "inconclusive": ("partly", "This log cannot tell"),
}
_UNITS_SHOWN = 2


@dataclass(frozen=True)
class AxisRow:
    """One axis of one pair, numbers in words."""

    pair: str
    axis: str
    status: str
    mood: str  # class of the page's colours
    off: str
    sigma: str
    limit: str
    shown: str
    reason: str


@dataclass(frozen=True)
class InUseView:
    """The page's first screen."""

    mood: str
    headline: str
    explained: str
    rows: list[AxisRow]


def in_use_view(answer: str, checks: Sequence[Mapping[str, object]]) -> InUseView:
    """From the answer and the checks of `boresight verify`, as its JSON has them."""
    rows = [_row(check) for check in checks]
    mood, headline = _ANSWERS[answer]
    told = {
        status: [f"{r.pair} {r.axis}" for r in rows if r.status == status]
        for status in ("fail", "inconclusive")
    }
    sentences = [
        f"Wrong: {', '.join(told['fail'])}." if told["fail"] else "",
        f"Not to be told from this log: {', '.join(told['inconclusive'])}." if told["inconclusive"] else "",
    ]
    explained = " ".join(s for s in sentences if s) or "Every axis that is judged passes."
    return InUseView(mood, headline, explained, rows)


def _row(check: Mapping[str, object]) -> AxisRow:
    status = str(check["status"])
    return AxisRow(
        pair=_spoken(str(check["pair"]), str(check["kind"])),
        axis=str(check["axis"]),
        status=status,
        mood=_MOODS[status],
        off=_deg(check["off_rad"]),
        sigma=_deg(check["sigma_rad"]),
        limit=_deg(check["limit_rad"]),
        shown=_deg(check["shown_rad"]),
        reason=str(check["reason"]),
    )


def _deg(angle_rad: object) -> str:
    if not isinstance(angle_rad, float) or not math.isfinite(angle_rad):
        return "unknown"
    return f"{np.degrees(angle_rad):.{_UNITS_SHOWN}f} deg"


def _spoken(pair: str, kind: str) -> str:
    """Kinds of sensors with a dash between them; names stay as they are."""
    return pair.replace("_", "-") if pair == kind else pair

"""Top of the page about the calibration in use: the answer in a sentence, and a line per axis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

__all__ = ["in_use_view"]

_MOODS = {"pass": "good", "warn": "partly", "fail": "bad", "inconclusive": "none"}
_ANSWERS = {
    "right": ("good", "Yes, as far as it matters"),
    "wrong": ("bad", "No"),
    "inconclusive": ("partly", "This log does not decide"),
}


def in_use_view(answer: str, checks: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The page's first screen, from the answer and the checks in the JSON of `boresight verify`."""
    rows = [_row(check) for check in checks]
    mood, headline = _ANSWERS[answer]
    wrong, unsure = (
        ", ".join(f"{r['pair']} {r['axis']}" for r in rows if r["status"] == status)
        for status in ("fail", "inconclusive")
    )
    sentences = [f"Wrong: {wrong}."] * bool(wrong) + [f"This log does not determine: {unsure}."] * bool(
        unsure
    )
    explained = " ".join(sentences) or "Every axis that is judged passes."
    return {"mood": mood, "headline": headline, "explained": explained, "rows": rows}


def _row(check: Mapping[str, Any]) -> dict[str, Any]:
    """A check with its angles in words, and the class of the page's colours."""
    # Kinds of sensors have a dash between them; names stay as they are.
    pair = check["pair"].replace("_", "-") if check["pair"] == check["kind"] else check["pair"]
    angles = {name: _deg(check[f"{name}_rad"]) for name in ("off", "sigma", "limit", "shown")}
    return {**check, **angles, "pair": pair, "mood": _MOODS[check["status"]]}


def _deg(angle_rad: object) -> str:
    if not isinstance(angle_rad, float) or not math.isfinite(angle_rad):
        return "unknown"
    return f"{np.degrees(angle_rad):.2f} deg"

"""The page of `boresight verify-set`: whether the calibrations that a data set ships are right, with uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.report.page import render
from schemas.set_checks import SetCheck

__all__ = ["log_set_page"]

_LISTED = 200  # logs by name; all are in the Parquet file


def log_set_page(
    name: str, told: Mapping[str, Any], shipped: Sequence[SetCheck], claims: Sequence[Mapping[str, Any]]
) -> str:
    """HTML of a judged data set.

    Args:
        name: name of the fleet.
        told: summary of the command: counts, sensors, shipped, turns, named, copies.
        shipped: rows of the shipped calibrations.
        claims: claims with their verdicts.
    """
    kinds = dict.fromkeys(_kind(s["kind"]) for s in told["sensors"])
    logs = _not_right(shipped)
    return render(
        "log_set.html",
        **{**told, "name": name, "claims": claims, "headline": _headline(told), "axes": len(shipped)},
        kinds={kind: [s for s in told["sensors"] if _kind(s["kind"]) == kind] for kind in kinds},
        lines=logs[:_LISTED],
        lines_left=max(len(logs) - _LISTED, 0),
        listed=_LISTED,
    )


def _headline(told: Mapping[str, Any]) -> tuple[str, str, str]:
    """Colour class of the headline, its text, and the sentence below it."""
    right, wrong, open_ = (told["answers"].get(a, 0) for a in ("right", "wrong", "undecided"))
    silent = sum(told["no_answer"].values())
    mood, words = (
        ("bad", f"{wrong} of {right + wrong + open_} answers say wrong")
        if wrong
        else ("partly" if open_ else "good", "No log calls a sensor wrong")
        if right
        else ("none", "These logs do not decide")
    )
    counts = f"answers about one sensor of one log: {right} right, {wrong} wrong, {open_} undecided."
    named = f" {silent} logs gave no answer at all; they are named below." if silent else ""
    return mood, words, f"{told['logs']} logs; {counts}{named}"


def _kind(pair: str) -> str:
    """Kind of the sensor whose answers have limits of this kind of pair."""
    return {"camera_lidar": "camera", "lidar_lidar": "lidar", "lidar_base": "base"}.get(pair, "radar")


def _not_right(shipped: Sequence[SetCheck]) -> list[dict[str, Any]]:
    """A line per log and sensor that is not right, wrong ones first, with the reasons."""
    found: dict[tuple[str, str, str, str], list[SetCheck]] = {}
    for row in shipped:
        if row.answer != "right":
            found.setdefault((row.vehicle, row.day, row.log, row.sensor), []).append(row)
    lines = []
    for rows in found.values():
        status = "fail" if rows[0].answer == "wrong" else "inconclusive"
        why = dict.fromkeys(f"{r.axis}: {r.reason}" for r in rows if r.status == status)
        lines.append({"row": rows[0], "why": list(why)})
    return sorted(lines, key=lambda line: line["row"].answer != "wrong")

"""A status word for each vehicle-day, shared by summaries, commands, files and pages."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

__all__ = ["DAY_WORDS", "day_word"]

# Most urgent first.
DAY_WORDS: Final = {
    "failed": "an error occurred; the next night tries again",
    "missing": "no logs, although other vehicles drove; or the night ended early",
    "refused": "nothing computed",
    "held": "computed, the prior stays current",
    "partly": "some pairs accepted",
    "done": "all pairs accepted, use it",
}


def day_word(pairs: Iterable[str]) -> str:
    """Status word for a day or a calibration, from the statuses of its pairs (for a state: current)."""
    seen = set(pairs)
    good = seen & {"accepted", "current"}
    if good:
        return "done" if seen == good else "partly"
    return "held" if "held" in seen else "refused"

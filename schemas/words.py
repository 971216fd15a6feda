"""One word for each state of a vehicle-day, for every summary, command, file and page."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

__all__ = ["DAY_WORDS", "day_word"]

# What a person should look at first comes first.
DAY_WORDS: Final = {
    "failed": "something broke, and the next night tries it again",
    "missing": "others drove and this vehicle has no logs, or the night ended early",
    "refused": "nothing computed",
    "held": "computed, the prior stays current",
    "partly": "some pairs accepted",
    "done": "all pairs accepted, use it",
}


def day_word(pairs: Iterable[str]) -> str:
    """The word for a day, or a calibration, from the statuses of its pairs: accepted (of a state: current) or not."""
    seen = set(pairs)
    good = seen & {"accepted", "current"}
    if good:
        return "done" if seen == good else "partly"
    return "held" if "held" in seen else "refused"

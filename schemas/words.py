"""A status word for each vehicle-day, shared by summaries, commands, files and pages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

__all__ = ["AXIS_NAMES", "DAY_WORDS", "axes_in_words", "day_word"]

_BODY = ("roll", "pitch", "yaw", "forward", "left", "up")
_OPTICAL = ("pitch", "yaw", "roll", "right", "down", "forward")
# Degrees of freedom of a change, along the axes of a kind of sensor.
AXIS_NAMES: Final = {"camera": _OPTICAL, "lidar": _BODY, "radar": _BODY, "base": _BODY}
# Most urgent first.
DAY_WORDS: Final = {
    "failed": "an error occurred; the next night tries again",
    "missing": "no logs, although other vehicles drove; or the night ended early",
    "refused": "nothing computed",
    "held": "computed, the prior stays in use",
    "partly": "some pairs accepted",
    "done": "all pairs accepted, use it",
}


def day_word(pairs: Iterable[str]) -> str:
    """Status word for a day or a calibration, from the statuses of its pairs (for a state: current, prior)."""
    seen = set(pairs)
    good = seen & {"accepted", "current"}
    if good:
        return "done" if seen == good else "partly"
    return "held" if seen & {"held", "prior"} else "refused"


def axes_in_words(kind: str, observable: Sequence[bool], certified: Sequence[str]) -> str:
    """Which axes are used, which directions certified, what stays at the prior, in one line.

    Args:
        kind: of the parent sensor, along whose axes the degrees of freedom are.
        observable: by degree of freedom, whether the days determine it.
        certified: directions.
    """
    names = AXIS_NAMES[kind]
    used = ", ".join(n for n, seen in zip(names, observable, strict=True) if seen)
    resting = ", ".join(n for n, seen in zip(names, observable, strict=True) if not seen)
    parts = [f"used: {used or 'nothing'}", f"certified: {', '.join(certified) or 'nothing'}"]
    return "; ".join([*parts, f"at the prior: {resting}"] if resting else parts)

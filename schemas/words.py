"""Every status with its sentence, and every next step: shared by tables, summaries, commands, files and pages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

__all__ = [
    "AXIS_NAMES", "DAY_WORDS", "NEXT_STEPS", "RECORD_WORDS", "STATE_WORDS", "VEHICLE_WORDS",
    "axes_in_words", "day_word", "listed", "sentences_of",
]  # fmt: skip

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
RECORD_WORDS: Final = {
    "accepted": "shown to be better than the prior",
    "held": "not shown to be better than the prior, which stays in use",
    "refused": "nothing computed",
}
STATE_WORDS: Final = {
    "current": "days since the last change determine it",
    "prior": "no such day: the pose is the prior",
    "none": "not even a prior is known",
}
VEHICLE_WORDS: Final = {
    "RED": "a chart is RED: a lasting change above the limit",
    "YELLOW": "a chart is YELLOW: a change below the limit, or not yet certain",
    "UNKNOWN": "a rotation of some sensor might not have been detected",
    "GREEN": "a rotation of any sensor would have been detected",
}
_LOAD = (
    "load the state of tonight, which has only days since the change: `boresight export ros2 {of} --out {out}` "
    "(`boresight export --help` lists other formats)."
)
# By a vehicle's status, after the comma what it lacks. Commands run as printed.
NEXT_STEPS: Final = {
    "RED": "inspect the mounting of {what}; after the repair, run {service} (replace {day}, the last audited day, by "
    f"the day of the repair). Until then {_LOAD}",
    "YELLOW": f"{_LOAD} If somebody moved {{what}}, run {{service}} (replace {{day}}, the first day with the change, "
    "by the day of the work); else inspect the mounting at the next service.",
    "YELLOW, days": "drive, then look again tomorrow: `boresight status {of}`.",
    "UNKNOWN, days": "drive until {days} accepted.",
    "UNKNOWN, many days": "drive other roads; {number} more days like these would be required. The pages of its days "
    "list what to drive.",
    "UNKNOWN, tables": "repair the tables: `boresight repair --lake {lake}`.",
}


def listed(words: Mapping[str, str]) -> str:
    """Statuses with their sentences, as columns describe them."""
    return ", ".join(f"{word} ({sentence})" for word, sentence in words.items())


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


def sentences_of(templates: Mapping[str, str]) -> Callable[..., str]:
    """A function that gives one of a room's sentences by its name, with its fields filled."""

    def because(name: str, /, **fields: object) -> str:
        return templates[name].format(**fields)

    return because

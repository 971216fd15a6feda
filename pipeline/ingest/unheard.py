"""Topics of fleet.toml without a usable message in the logs, and whether fleet.toml is the cause."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from difflib import SequenceMatcher

from pipeline.ingest.index import ACCEPTED_TYPES, DayIndex
from pipeline.ingest.roles import INFO, NEEDED, TF_STATIC, Role, topics_of
from pipeline.rig.rig import Rig

__all__ = ["Unheard", "unheard_topics"]

_CALIBRATED = "log a sensor_msgs/CameraInfo with a calibrated K"
_SHOWN = 4  # similar topics named in a sentence
_MISTYPED = 0.8  # similarity of a mistyped name; other images, for example, are no labels


@dataclass(frozen=True)
class Unheard:
    """A topic without a message of a type that its role accepts.

    Args:
        types: types of its messages; empty without messages.
        others: topics of the logs with an accepted type that the rig does not name, the most similar first.
        is_shown: True for a CameraInfo whose images are there.
    """

    topic: str
    role: Role
    types: tuple[str, ...]
    others: tuple[str, ...]
    is_shown: bool = False

    @property
    def is_misconfigured(self) -> bool:
        """Whether fleet.toml or the recording must be corrected; else the sensor may only be silent."""
        return bool(self.types or self.others) or self.is_shown

    @property
    def problem(self) -> str:
        """Problem and correction, without the topic."""
        wanted = ACCEPTED_TYPES[self.role.what]
        what = f"type {', '.join(self.types)}, not {' or '.join(wanted)}" if self.types else "no message"
        if set(self.types) & set(wanted):
            return f"no usable intrinsics: {_CALIBRATED}"
        if self.others:
            named = ", ".join(self.others[:_SHOWN])
            return f"{what}; the same type comes on {named}: correct the topic in fleet.toml"
        if self.is_shown:
            return f"{what}: {_CALIBRATED}"
        return f"{what}: correct the topic in fleet.toml" if self.types else what

    def __str__(self) -> str:
        return f"{self.topic} ({self.role}): {self.problem}"


def unheard_topics(index: DayIndex, rig: Rig) -> list[Unheard]:
    """Topics of the rig without a usable message: those that it needs, and others that a similar topic replaces.

    Transforms are not among them: a prior file may take their place.
    """
    return list(_unheard(index, rig))


def _unheard(index: DayIndex, rig: Rig) -> Iterator[Unheard]:
    named = topics_of(rig)
    for topic, role in named.items():
        wanted, types = set(ACCEPTED_TYPES[role.what]), index.types_of(topic)
        is_shown = role.what == INFO and bool(index.captures(role.sensor).stamps)
        is_blind = is_shown and not index.cameras.get(role.sensor)
        if role == TF_STATIC or (wanted & types and not is_blind):
            continue
        alike = {name: SequenceMatcher(None, topic, name).ratio() for name, kind in index.types_beside()
                 if kind in wanted and name not in named}  # fmt: skip
        others = sorted(alike, key=lambda name: (-alike[name], name))
        if role.what not in NEEDED:
            others = [name for name in others if alike[name] >= _MISTYPED]
            if not (others or types):
                continue
        yield Unheard(topic, role, tuple(sorted(types)), tuple(others), is_shown)

"""What a container's own index says of a log, and stretches of log time: what lets a part of a log be read alone."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int64

__all__ = ["Chunk", "Stretches", "Timeline", "timeline_of_chunks"]

# Messages of a driving car come every tenth of a second: where none came for so long, nothing was recorded.
_PAUSE_NS = 2 * 10**9


@dataclass(frozen=True)
class Stretches:
    """Stretches of log time [ns], both ends included, disjoint and in order."""

    spans_ns: tuple[tuple[int, int], ...]
    _starts: tuple[int, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_starts", tuple(start for start, _ in self.spans_ns))

    @classmethod
    def merged(cls, spans_ns: Iterable[tuple[int, int]], pause_ns: int = 0) -> Stretches:
        """Of any spans: those that overlap, or lie no further apart than a pause, become one."""
        found: list[tuple[int, int]] = []
        for start, end in sorted(spans_ns):
            if found and start <= found[-1][1] + pause_ns:
                found[-1] = (found[-1][0], max(found[-1][1], end))
            else:
                found.append((start, end))
        return cls(tuple(found))

    @classmethod
    def of_times(cls, times_ns: Int64[np.ndarray, " N"]) -> Stretches:
        """Of messages by their times, in order: those that no pause parts lie in one stretch."""
        if not len(times_ns):
            return cls(())
        ends = np.flatnonzero(np.diff(times_ns) > _PAUSE_NS)
        starts = times_ns[np.concatenate([[0], ends + 1])]
        return cls(tuple(zip(starts.tolist(), [*times_ns[ends].tolist(), int(times_ns[-1])], strict=True)))

    def __contains__(self, time_ns: int) -> bool:
        return self.touch(time_ns, time_ns)

    def touch(self, start_ns: int, end_ns: int) -> bool:
        """Whether a span and any of the stretches have a moment in common."""
        i = bisect_right(self._starts, end_ns)
        return i > 0 and self.spans_ns[i - 1][1] >= start_ns

    def widened(self, by_ns: int) -> Stretches:
        """All of them, longer by so much at both ends."""
        return Stretches.merged((start - by_ns, end + by_ns) for start, end in self.spans_ns)

    @property
    def length_ns(self) -> int:
        """How long they are together."""
        return sum(end - start for start, end in self.spans_ns)


@dataclass(frozen=True)
class Timeline:
    """When a log was recorded, how many messages a topic has, and between when its first one was logged."""

    recorded: Stretches
    messages: Mapping[str, int]
    first: Mapping[str, tuple[int, int]]

    @classmethod
    def joined(cls, parts: Iterable[Timeline]) -> Timeline:
        """Of several logs as one."""
        spans: list[tuple[int, int]] = []
        messages: dict[str, int] = {}
        first: dict[str, tuple[int, int]] = {}
        for part in parts:
            spans += part.recorded.spans_ns
            for topic, count in part.messages.items():
                messages[topic] = messages.get(topic, 0) + count
            for topic, span in part.first.items():
                first[topic] = min(span, first.get(topic, span))
        return cls(Stretches.merged(spans, _PAUSE_NS), messages, first)


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk as an index knows it: where it lies, between when its messages were logged, of which channels.

    `channels` is None where the index does not say.
    """

    position: int
    length: int
    start_ns: int
    end_ns: int
    channels: frozenset[int] | None


def timeline_of_chunks(
    chunks: Iterable[Chunk], topics: Mapping[int, str], messages: Mapping[int, int]
) -> Timeline:
    """The timeline of a chunked log.

    Args:
        chunks: of the log's index.
        topics: of each channel.
        messages: number of each channel's messages.
    """
    counts: dict[str, int] = {}
    for channel, count in messages.items():
        if channel in topics:
            counts[topics[channel]] = counts.get(topics[channel], 0) + count
    first: dict[str, tuple[int, int]] = {}
    # Without those that have no message, or whose index is damaged.
    filled = sorted((c for c in chunks if 0 < c.end_ns >= c.start_ns), key=lambda c: c.start_ns)
    typical_ns = int(np.median([c.end_ns - c.start_ns for c in filled])) if filled else 0
    spans = []
    for chunk in filled:
        spans += _without_pause(chunk, typical_ns)
        for channel in topics if chunk.channels is None else chunk.channels:
            if channel in topics:
                first.setdefault(topics[channel], (chunk.start_ns, chunk.end_ns))
    return Timeline(Stretches.merged(spans, _PAUSE_NS), counts, first)


def _without_pause(chunk: Chunk, typical_ns: int) -> list[tuple[int, int]]:
    """When a chunk's messages were logged, as far as its span tells: chunks hold equal amounts of data.

    One that took much longer than others to fill was begun before a pause and ended after it.
    """
    if chunk.end_ns - chunk.start_ns <= 3 * typical_ns + _PAUSE_NS:
        return [(chunk.start_ns, chunk.end_ns)]
    half = typical_ns // 2
    return [(chunk.start_ns, chunk.start_ns + half), (chunk.end_ns - half, chunk.end_ns)]

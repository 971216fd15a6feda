"""The content of a container's index and stretches of log time, for reading parts of a log."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int64

__all__ = ["PAUSE_NS", "Chunk", "Counted", "Stretches", "Timeline", "timeline_of_chunks"]

# A driving car logs messages every tenth of a second: after a gap of this length, recording was paused.
PAUSE_NS = 2 * 10**9


@dataclass(frozen=True)
class Stretches:
    """Stretches of log time [ns], both ends included, disjoint and in order."""

    spans_ns: tuple[tuple[int, int], ...]
    _starts: tuple[int, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_starts", tuple(start for start, _ in self.spans_ns))

    @classmethod
    def merged(cls, spans_ns: Iterable[tuple[int, int]], pause_ns: int = 0) -> Stretches:
        """Stretches from any spans: overlapping ones, and those no further apart than a pause, are merged."""
        found: list[tuple[int, int]] = []
        for start, end in sorted(spans_ns):
            if found and start <= found[-1][1] + pause_ns:
                found[-1] = (found[-1][0], max(found[-1][1], end))
            else:
                found.append((start, end))
        return cls(tuple(found))

    @classmethod
    def of_times(cls, times_ns: Int64[np.ndarray, " N"]) -> Stretches:
        """Stretches of messages from their times, in order; one for all messages without a pause."""
        if not len(times_ns):
            return cls(())
        ends = np.flatnonzero(np.diff(times_ns) > PAUSE_NS)
        starts = times_ns[np.concatenate([[0], ends + 1])]
        return cls(tuple(zip(starts.tolist(), [*times_ns[ends].tolist(), int(times_ns[-1])], strict=True)))

    def __contains__(self, time_ns: int) -> bool:
        return self.touch(time_ns, time_ns)

    def touch(self, start_ns: int, end_ns: int) -> bool:
        """Whether a span overlaps any of the stretches."""
        i = bisect_right(self._starts, end_ns)
        return i > 0 and self.spans_ns[i - 1][1] >= start_ns

    def widened(self, by_ns: int) -> Stretches:
        """Stretches extended by `by_ns` at both ends."""
        return Stretches.merged((start - by_ns, end + by_ns) for start, end in self.spans_ns)

    @property
    def length_ns(self) -> int:
        """Total length [ns]."""
        return sum(end - start for start, end in self.spans_ns)


@dataclass(frozen=True, eq=False)
class Counted:
    """Message counts of an index: start, end and number of each span; fractions if only estimated."""

    start_ns: Int64[np.ndarray, " K"]
    end_ns: Int64[np.ndarray, " K"]
    messages: Float[np.ndarray, " K"]

    @classmethod
    def of(cls, parts: Iterable[tuple[int, int, float]]) -> Counted:
        """Counts from (start, end, number) of each span."""
        start, end, messages = zip(*parts, strict=True)
        return cls(np.array(start, np.int64), np.array(end, np.int64), np.array(messages, np.float64))

    @classmethod
    def joined(cls, parts: Sequence[Counted]) -> Counted:
        """Counts of several logs as one."""
        columns = zip(*((p.start_ns, p.end_ns, p.messages) for p in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def evened(self, recorded: Stretches) -> Counted:
        """Counts with one span per stretch of steady messages: chunks end by size, not by time."""
        begins = np.array([start for start, _ in recorded.spans_ns], np.int64)
        kept: list[tuple[int, int, float]] = []
        stretch = np.searchsorted(begins, self.start_ns, "right")
        order = np.lexsort((self.end_ns, stretch))
        for part in np.split(order, np.flatnonzero(np.diff(stretch[order])) + 1):
            start, end = int(self.start_ns[part].min()), int(self.end_ns[part].max())
            total, after = float(self.messages[part].sum()), np.cumsum(self.messages[part])
            steady = total * (self.end_ns[part] - start) / max(end - start, 1)
            # Chunks may overlap; the last message of one may be counted in the next.
            if np.abs(after - steady).max() <= self.messages[part].max() + 1:
                kept.append((start, end, total))
            else:
                columns = (self.start_ns[part], self.end_ns[part], self.messages[part])
                kept += zip(*(column.tolist() for column in columns), strict=True)
        return Counted.of(kept)

    def times_ns(self) -> Int64[np.ndarray, " N"]:
        """Log time of each message, in order: evenly spread within the span that counts it."""
        order = np.argsort(self.start_ns, kind="stable")
        messages = self.messages[order]
        after = np.cumsum(messages)
        if not len(after):
            return np.zeros(0, np.int64)
        # origin within the day, so that a double represents nanoseconds
        origin = int(self.start_ns[order[0]])
        spans = np.stack([self.start_ns[order], self.end_ns[order]], axis=1) - origin
        counts = np.stack([after - messages, after], axis=1)
        number = np.arange(round(float(after[-1]))) + 0.5
        return np.sort(
            np.interp(number, counts.ravel(), spans.ravel().astype(float)).astype(np.int64) + origin
        )


@dataclass(frozen=True)
class Timeline:
    """Recorded stretches of a log, message counts by topic, and the span of each topic's first message."""

    recorded: Stretches
    messages: Mapping[str, int]
    first: Mapping[str, tuple[int, int]]
    counted: Mapping[str, Counted] = field(default_factory=dict)

    @classmethod
    def joined(cls, parts: Iterable[Timeline]) -> Timeline:
        """Timeline of several logs as one."""
        spans: list[tuple[int, int]] = []
        messages = Counter[str]()
        first: dict[str, tuple[int, int]] = {}
        counted: dict[str, list[Counted]] = {}
        for part in parts:
            spans += part.recorded.spans_ns
            for topic, its in part.counted.items():
                counted.setdefault(topic, []).append(its)
            messages.update(part.messages)
            for topic, span in part.first.items():
                first[topic] = min(span, first.get(topic, span))
        together = {topic: Counted.joined(of_topic) for topic, of_topic in counted.items()}
        return cls(Stretches.merged(spans, PAUSE_NS), messages, first, together)


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk in the index: its position, the span of its messages, and their channels.

    `channels` is None if the index does not list them; `messages` by channel, if the index counts them.
    """

    position: int
    length: int
    start_ns: int
    end_ns: int
    channels: frozenset[int] | None
    messages: Mapping[int, int] = field(default_factory=dict)


def timeline_of_chunks(
    chunks: Iterable[Chunk], topics: Mapping[int, str], messages: Mapping[int, int]
) -> Timeline:
    """Timeline of a log from the chunks of its index; `topics` and `messages` are by channel."""
    counts = Counter[str]()
    for channel in messages.keys() & topics.keys():
        counts[topics[channel]] += messages[channel]
    first: dict[str, tuple[int, int]] = {}
    # Without chunks that have no message or a damaged index.
    filled = sorted((c for c in chunks if 0 < c.end_ns >= c.start_ns), key=lambda c: c.start_ns)
    typical_ns = int(np.median([c.end_ns - c.start_ns for c in filled])) if filled else 0
    spans = []
    for chunk in filled:
        spans += _without_pause(chunk, typical_ns)
        for channel in _channels(chunk, topics):
            first.setdefault(topics[channel], (chunk.start_ns, chunk.end_ns))
    recorded = Stretches.merged(spans, PAUSE_NS)
    counted = _counted(filled, topics, messages, typical_ns)
    evened = {topic: its.evened(recorded) for topic, its in counted.items()}
    return Timeline(recorded, counts, first, evened)


def _counted(
    chunks: Sequence[Chunk], topics: Mapping[int, str], messages: Mapping[int, int], typical_ns: int
) -> dict[str, Counted]:
    """Messages of each topic by chunk: counts of the index, else the chunk's share of bytes."""
    bytes_of = Counter[int]()
    for chunk in chunks:
        bytes_of.update(dict.fromkeys(_channels(chunk, topics), max(chunk.length, 1)))
    found: dict[str, list[tuple[int, int, float]]] = {}
    for chunk in chunks:
        spans = _without_pause(chunk, typical_ns)
        for channel in _channels(chunk, topics):
            share = messages.get(channel, 0) * max(chunk.length, 1) / bytes_of[channel]
            count = chunk.messages.get(channel, share) / len(spans)
            found.setdefault(topics[channel], []).extend((*span, count) for span in spans)
    return {topic: Counted.of(parts) for topic, parts in found.items()}


def _channels(chunk: Chunk, topics: Mapping[int, str]) -> Iterable[int]:
    return topics.keys() if chunk.channels is None else chunk.channels & topics.keys()


def _without_pause(chunk: Chunk, typical_ns: int) -> list[tuple[int, int]]:
    """Recorded stretches of a chunk, estimated from its span: chunks hold equal amounts of data.

    If a chunk took much longer to fill than the others, its span includes a pause.
    """
    if chunk.end_ns - chunk.start_ns <= 3 * typical_ns + PAUSE_NS:
        return [(chunk.start_ns, chunk.end_ns)]
    half = typical_ns // 2
    return [(chunk.start_ns, chunk.start_ns + half), (chunk.end_ns - half, chunk.end_ns)]

"""Which bursts of a long day are read: within what was recorded, spread over what the car did."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.ingest.containers.timeline import Chunk, Stretches, timeline_of_chunks
from pipeline.ingest.reading_plan import BURST_TRIOS, choose_bursts, possible_bursts

S = 10**9
gaps = st.lists(st.tuples(st.integers(1, 4000), st.integers(3, 4000)), min_size=1, max_size=12)


def logged(lengths_and_gaps_s, rate_hz=10):
    """Sweeps of drives, each so long and followed by such a pause, at 10 Hz."""
    at, times = 1_700_000_000 * S, []
    for length, gap in lengths_and_gaps_s:
        times.append(at + np.arange(length * rate_hz) * (S // rate_hz))
        at += (length + gap) * S
    return np.concatenate(times)


@given(gaps, st.integers(1, 2000), st.booleans())
def test_possible_bursts_hold_equally_many_sweeps_without_a_pause_where_that_can_be(parts, budget, known):
    times = logged(parts)
    found = possible_bursts(times, budget, is_motion_known=known)
    length = found.sweeps
    in_long = sum(10 * n for n, _ in parts if 10 * n >= BURST_TRIOS)
    assert (length == BURST_TRIOS) == (2 * in_long >= len(times))
    drives = np.cumsum(np.diff(times, prepend=times[0]) > 2 * S)
    for (start, end), (before, middle, after) in zip(found.spans_ns, found.middle_ns, strict=True):
        inside = (times >= start) & (times <= end)
        assert inside.sum() == length
        assert before <= middle <= after
        its_drive = drives[np.searchsorted(times, middle)]
        if (drives == its_drive).sum() >= length:
            assert set(drives[inside]) == {its_drive}
    assert np.all(np.diff(found.spans_ns[:, 0]) >= 0)
    assert len(found.spans_ns) <= -(-budget // length) * (3 if known else 1)


@given(st.lists(st.tuples(st.integers(0, 100), st.integers(0, 100)), max_size=20), st.integers(-5, 110))
def test_a_moment_is_in_stretches_where_it_is_in_one_of_the_spans_they_were_merged_from(spans, moment):
    spans = [(min(s), max(s)) for s in spans]
    merged = Stretches.merged(spans)
    assert (moment in merged) == any(a <= moment <= b for a, b in spans)
    assert all(b < c for (_, b), (c, _) in zip(merged.spans_ns, merged.spans_ns[1:], strict=False))


@given(st.integers(1, 60), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_as_many_bursts_are_chosen_as_asked_for_each_once_and_in_order(possible, count, seed):
    rng = np.random.default_rng(seed)
    drive = rng.normal((15, 0, 0, 0), (5, 0.1, 1e3, 1e3), (possible, 4))
    chosen = choose_bursts(drive, count)
    assert len(chosen) == min(possible, count)
    assert chosen == sorted(set(chosen))
    assert chosen == choose_bursts(drive, count)


def test_of_a_day_that_mostly_stood_the_driven_part_is_read():
    # 60 possible bursts: parked but for 15, at several speeds, in bends and at several places.
    motion, driven = np.zeros((60, 4)), np.arange(20, 35)
    motion[driven, 0] = np.linspace(2, 30, 15)
    motion[driven, 1] = np.linspace(-0.3, 0.3, 15)
    motion[driven, 2] = 250.0 * np.arange(15)
    chosen = choose_bursts(motion, 20)
    assert np.isin(driven, chosen).sum() >= 13  # an even spread would have 5
    assert min(chosen) < 20  # and the rest of the day is not forgotten
    assert max(chosen) >= 35


@pytest.mark.parametrize(("kind", "value"), [(0, 28.0), (1, 0.2), (2, 5e3)], ids=["speed", "turn", "place"])
def test_what_comes_once_a_day_is_read(kind, value):
    motion = np.tile([12.0, 0, 0, 0], (60, 1))
    motion[47, kind] = value
    assert 47 in choose_bursts(motion, 20)


def test_a_pause_within_a_chunk_is_no_recorded_time():
    # Ten drives of 40 s, a minute apart; chunks hold 6 s of data, whatever pause comes while they are filled.
    driven = np.concatenate([100 * drive + np.arange(400) / 10 for drive in range(10)])
    times = ((1_700_000_000 + driven) * S).astype(np.int64)
    chunks = [Chunk(i, 1, int(t[0]), int(t[-1]), None) for i, t in enumerate(np.array_split(times, 67))]
    timeline = timeline_of_chunks(chunks, {1: "/lidar"}, {1: len(times)})
    assert timeline.messages == {"/lidar": 4000}
    assert timeline.recorded.length_ns / S == pytest.approx(400, rel=0.1)
    found = possible_bursts(timeline.counted["/lidar"].times_ns(), 400, is_motion_known=False).spans_ns
    read = sum(int(((times >= start) & (times <= end)).sum()) for start, end in found)
    assert read == pytest.approx(400, rel=0.1)

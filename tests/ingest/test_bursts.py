"""Which bursts of a long day are read: within what was recorded, spread over what the car did."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.ingest.bursts import BURST_TRIOS, BurstMotion, choose_bursts, possible_bursts
from pipeline.ingest.containers.timeline import Chunk, Stretches, timeline_of_chunks

S = 10**9
gaps = st.lists(st.tuples(st.integers(1, 4000), st.integers(3, 4000)), min_size=1, max_size=12)


def recorded(lengths_and_gaps_s):
    spans, at = [], 1_700_000_000
    for length, gap in lengths_and_gaps_s:
        spans.append((at * S, (at + length) * S))
        at += length + gap
    return Stretches.merged(spans)


@given(gaps, st.integers(1, 2000), st.booleans())
def test_possible_bursts_lie_within_what_was_recorded_and_are_of_one_length(parts, budget, known):
    day = recorded(parts)
    sweeps = max(BURST_TRIOS, 10 * day.length_ns // S)
    found = possible_bursts(day, sweeps, budget, is_motion_known=known)
    burst_ns = day.length_ns * BURST_TRIOS / sweeps
    for start, end in found:
        inside = [(a, b) for a, b in day.spans_ns if a <= start and end <= b]
        assert inside
        assert end - start <= burst_ns + 1
        # Shorter only where the stretch itself is.
        assert end - start >= min(burst_ns, inside[0][1] - inside[0][0]) - 1
    assert np.all(np.diff(found[:, 0]) >= 0)
    assert len(found) <= -(-budget // BURST_TRIOS) * (3 if known else 1)


@given(st.lists(st.tuples(st.integers(0, 100), st.integers(0, 100)), max_size=20), st.integers(-5, 110))
def test_a_moment_is_in_stretches_where_it_is_in_one_of_the_spans_they_were_merged_from(spans, moment):
    spans = [(min(s), max(s)) for s in spans]
    merged = Stretches.merged(spans)
    assert (moment in merged) == any(a <= moment <= b for a, b in spans)
    assert all(b < c for (_, b), (c, _) in zip(merged.spans_ns, merged.spans_ns[1:], strict=False))


def motion(speed, yaw_rate=None, position=None):
    speed = np.asarray(speed, float)
    unknown = BurstMotion.unknown(len(speed))
    return BurstMotion(
        speed,
        unknown.yaw_rate_radps if yaw_rate is None else np.asarray(yaw_rate, float),
        unknown.position_m if position is None else np.asarray(position, float),
    )


@given(st.integers(1, 60), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_as_many_bursts_are_chosen_as_asked_for_each_once_and_in_order(possible, count, seed):
    rng = np.random.default_rng(seed)
    drive = motion(
        rng.uniform(0, 30, possible), rng.normal(0, 0.1, possible), rng.normal(0, 1e3, (possible, 2))
    )
    chosen = choose_bursts(drive, count)
    assert len(chosen) == min(possible, count)
    assert chosen == sorted(set(chosen))
    assert chosen == choose_bursts(drive, count)


def test_nothing_known_of_the_motion_leaves_bursts_spread_over_time():
    chosen = choose_bursts(BurstMotion.unknown(60), 20)
    assert np.all(np.diff(chosen) <= 5)
    assert np.bincount(np.array(chosen) // 3, minlength=20).tolist() == [1] * 20


def test_of_a_day_that_mostly_stood_the_driven_part_is_read():
    # 60 possible bursts: parked but for 15, at several speeds, in bends and at several places.
    speed, yaw_rate, position = np.zeros(60), np.zeros(60), np.zeros((60, 2))
    driven = np.arange(20, 35)
    speed[driven] = np.linspace(2, 30, 15)
    yaw_rate[driven] = np.linspace(-0.3, 0.3, 15)
    position[driven, 0] = 250.0 * np.arange(15)
    chosen = choose_bursts(motion(speed, yaw_rate, position), 20)
    assert np.isin(driven, chosen).sum() >= 13  # an even spread would have 5
    assert min(chosen) < 20  # and the rest of the day is not forgotten
    assert max(chosen) >= 35


@pytest.mark.parametrize("kind", ["speed", "turn", "place"])
def test_what_comes_once_a_day_is_read(kind):
    speed, yaw_rate, position = np.full(60, 12.0), np.zeros(60), np.zeros((60, 2))
    {"speed": speed, "turn": yaw_rate, "place": position}[kind][47] = {
        "speed": 28.0,
        "turn": 0.2,
        "place": 5e3,
    }[kind]
    assert 47 in choose_bursts(motion(speed, yaw_rate, position), 20)


def test_a_pause_within_a_chunk_is_no_recorded_time():
    # Ten drives of 40 s, a minute apart; chunks hold 6 s of data, whatever pause comes while they are filled.
    driven = np.concatenate([100 * drive + np.arange(400) / 10 for drive in range(10)])
    times = ((1_700_000_000 + driven) * S).astype(np.int64)
    chunks = [Chunk(i, 1, int(t[0]), int(t[-1]), None) for i, t in enumerate(np.array_split(times, 67))]
    timeline = timeline_of_chunks(chunks, {1: "/lidar"}, {1: len(times)})
    assert timeline.messages == {"/lidar": 4000}
    assert timeline.recorded.length_ns / S == pytest.approx(400, rel=0.1)
    found = possible_bursts(timeline.recorded, 4000, 400, is_motion_known=False)
    read = sum(int(((times >= start) & (times <= end)).sum()) for start, end in found)
    assert read == pytest.approx(400, rel=0.1)

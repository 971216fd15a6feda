"""Moments by stamps alone: within the gate, one to one, each sweep accounted for."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.ingest.sync import (
    constant_gap_ns,
    first_occurrences,
    match_moments,
    match_nearest,
    number_drives,
)
from pipeline.objective.stamp_gaps import motion_gates_ns

stamps = st.lists(st.integers(0, 400), max_size=30).map(lambda v: np.array(v, np.int64))
GATE = 7
MS = 1_000_000


def seen(stamps_ns, places):
    """Stamps at the places, NaN where there is none."""
    return np.append(stamps_ns.astype(float), np.nan)[places]


captures = st.dictionaries(st.sampled_from("abcdefg"), stamps)


@settings(max_examples=300, deadline=None)
@given(stamps, captures, st.integers(0, 40), st.booleans())
def test_no_sweep_is_lost_captures_are_one_to_one_and_every_two_lie_within_the_gate(
    lidar, others, gate, by_motion
):
    found = match_moments(lidar, others, np.full(len(lidar), gate) if by_motion else gate)
    assert list(found.others) == list(others)
    together = [np.zeros(len(found.anchor))]
    for name, stamps_ns in others.items():
        own = found.others[name]
        assert len(set(stamps_ns[own[own >= 0]])) == np.sum(own >= 0)
        once = (s[first_occurrences(s)] for s in (lidar, stamps_ns))
        constant = constant_gap_ns(*once) if by_motion else 0
        together.append(seen(stamps_ns, own) - lidar[found.anchor] - constant)
    apart = np.nanmax(together, axis=0) - np.nanmin(together, axis=0)
    assert apart.size == 0 or apart.max() <= gate
    assert np.all(np.diff(lidar[found.anchor]) > 0)
    assert len(found.anchor) + sum(found.rejected.values()) == len(lidar)


@settings(max_examples=100, deadline=None)
@given(stamps, stamps, stamps, st.integers(0, 100))
def test_the_order_of_logging_does_not_matter(lidar, camera, radar, seed):
    rng = np.random.default_rng(seed)
    mixed = [rng.permutation(s) for s in (lidar, camera, radar)]
    both = (lidar, camera, radar)
    a, b = (match_moments(s[0], {"camera": s[1], "radar": s[2]}, GATE) for s in (both, mixed))
    assert both[0][a.anchor].tolist() == mixed[0][b.anchor].tolist()
    for i, name in enumerate(("camera", "radar"), start=1):
        np.testing.assert_array_equal(seen(both[i], a.others[name]), seen(mixed[i], b.others[name]))
    assert a.rejected == b.rejected


@settings(max_examples=200, deadline=None)
@given(stamps, stamps)
def test_no_pair_could_come_closer_than_the_partners_that_it_got(a, b):
    a, b = a[first_occurrences(a)], b[first_occurrences(b)]
    partner = match_nearest(a, b, GATE)
    held = {int(p): int(i) for i, p in enumerate(partner) if p >= 0}
    for i in range(len(a)):
        for j in range(len(b)):
            gap = abs(a[i] - b[j])
            happy_a = partner[i] >= 0 and abs(a[i] - b[partner[i]]) <= gap
            happy_b = j in held and abs(a[held[j]] - b[j]) <= gap
            assert gap > GATE or happy_a or happy_b


def test_a_gate_of_five_milliseconds_holds_between_every_two_sensors():
    lidar, camera = np.array([0]), np.array([3 * MS])
    found = match_moments(lidar, {"camera": camera, "radar": np.array([-2 * MS])}, 5 * MS)
    assert (found.others["camera"].tolist(), found.others["radar"].tolist()) == ([0], [0])
    apart = match_moments(lidar, {"camera": camera, "radar": np.array([-2 * MS - 1])}, 5 * MS)
    # The one farther from the sweep goes; the other's pair has what it needs.
    assert (apart.others["camera"].tolist(), apart.others["radar"].tolist()) == ([-1], [0])
    lidar, camera, radar = (np.array([0, 100 * MS]) + [0, late] for late in (0, 3 * MS, -2 * MS - 1))
    beside = match_moments(lidar, {"camera": camera, "radar": radar}, 5 * MS)
    assert beside.anchor.tolist() == [0]  # where a whole moment shows the same
    assert dict(beside.rejected) == {"camera_radar_outside_gate": 1}


def test_a_moment_of_many_sensors_lives_where_one_is_tied_to_the_anchor_whatever_it_lacks():
    sweeps = ticks(10, 0)
    others = {name: sweeps.copy() for name in "abcde"}
    others["a"], others["b"] = others["a"][::2], others["b"][::3]
    found = match_moments(sweeps, others, gates(sweeps, speed=0.0), tied={"a", "b", "c", "d", "e"})
    assert len(found.anchor) == len(sweeps)
    assert {s: int(np.sum(at >= 0)) for s, at in found.others.items()} == {s: len(others[s]) for s in others}
    found = match_moments(sweeps, others, gates(sweeps, speed=0.0), tied={"b"})
    assert (len(found.anchor), dict(found.rejected)) == (200, {"no_a_in_gate": 200, "no_b_in_gate": 200})


def test_of_many_sensors_each_is_gated_against_the_anchor_and_none_for_another():
    early_and_late = {"a": np.array([-4 * MS]), "b": np.array([4 * MS]), "c": np.array([6 * MS])}
    found = match_moments(np.array([0]), early_and_late, 5 * MS, tied={"a", "b", "c"})
    assert {s: at.tolist() for s, at in found.others.items()} == {"a": [0], "b": [0], "c": [-1]}


def ticks(rate_hz, phase_ms, seconds=60.0, jitter_ms=0.0):
    k = np.arange(int(seconds * rate_hz))
    jitter = np.random.default_rng(0).normal(0, jitter_ms, len(k))
    return ((k / rate_hz * 1e3 + phase_ms + jitter) * MS).astype(np.int64)


def gates(sweeps, speed=20.0, yaw_rate=0.1):
    return motion_gates_ns(np.full(len(sweeps), speed), np.full(len(sweeps), yaw_rate), 2.5, np.radians(2.0))


def test_every_sweep_of_free_running_sensors_gets_the_image_and_scan_nearest_to_it():
    sweeps, images, scans = ticks(10.03, 3, jitter_ms=0.1), ticks(30, 11), ticks(13, 40)
    found = match_moments(sweeps, {"camera": images, "radar": scans}, gates(sweeps, speed=35.0))
    assert min(found.others["radar"]) >= 0
    assert len(found.anchor) >= len(sweeps) - 2  # the last ones outlive the radar
    for stamps_ns, own in ((images, found.others["camera"]), (scans, found.others["radar"])):
        distance = np.abs(stamps_ns[None] - sweeps[found.anchor][:, None])
        np.testing.assert_array_equal(distance.argmin(1), own)
    strict = match_moments(sweeps, {"camera": images, "radar": scans}, 5 * MS)
    assert np.sum((strict.others["camera"] >= 0) & (strict.others["radar"] >= 0)) < 0.1 * len(sweeps)


@pytest.mark.parametrize("offset_ms", [-60.0, -25.0, 0.0, 25.0, 49.0, 50.0, 60.0])
def test_a_constant_offset_costs_no_sweep_and_is_found_up_to_whole_periods(offset_ms):
    sweeps = ticks(10, 0, jitter_ms=0.5)
    images, scans = sweeps + int(offset_ms * MS), sweeps + 2 * MS
    found = match_moments(sweeps, {"camera": images, "radar": scans}, gates(sweeps, speed=40.0))
    assert len(found.anchor) >= len(sweeps) - 1
    found_ms = constant_gap_ns(sweeps, images) / MS
    assert (found_ms - offset_ms + 50) % 100 - 50 == pytest.approx(0, abs=0.2)
    assert abs(found_ms) <= 50.2
    assert constant_gap_ns(sweeps, scans) / MS == pytest.approx(2.0, abs=0.2)


def test_where_a_message_is_missing_the_sweep_goes_and_takes_no_neighbour_s():
    sweeps = ticks(10, 0)
    images = np.delete(sweeps + MS, [5, 6, 17])
    found = match_moments(sweeps, {"camera": images, "radar": sweeps}, gates(sweeps, speed=0.0))
    assert dict(found.rejected) == {"no_camera_in_gate": 3}
    np.testing.assert_array_equal(np.setdiff1d(np.arange(len(sweeps)), found.anchor), [5, 6, 17])


def test_a_sensor_that_falls_silent_leaves_the_others_their_moments():
    sweeps = ticks(10, 0)
    scans = sweeps[:300] + MS
    found = match_moments(sweeps, {"camera": sweeps + 2 * MS, "radar": scans}, gates(sweeps, speed=0.0))
    without = np.flatnonzero(found.others["radar"] < 0)
    # Beside the last whole moment a second long nothing new is to be seen.
    np.testing.assert_array_equal(found.anchor[without], np.arange(310, len(sweeps)))
    assert dict(found.rejected) == {"no_radar_in_gate": 10}
    assert found.others["camera"].min() >= 0
    silent = match_moments(sweeps, {"camera": sweeps[:0], "radar": scans}, gates(sweeps, speed=0.0))
    np.testing.assert_array_equal(silent.anchor, np.arange(300))
    assert set(silent.others["camera"]) == {-1}
    assert dict(silent.rejected) == {"no_radar_in_gate": 300}


def test_the_faster_a_car_drives_or_turns_the_nearer_the_stamps_must_be():
    speed, yaw_rate = np.array([0.0, 20.0, 50.0, 20.0, np.nan]), np.array([0.0, 0.0, 0.0, 1.0, np.nan])
    found = motion_gates_ns(speed, yaw_rate, 2.5, np.radians(2.0)) / MS
    # Standing: what others drive at 10 m/s; unknown: 40 m/s and 30 deg/s.
    np.testing.assert_allclose(found, [250.0, 125.0, 50.0, 34.9, 62.5], atol=0.1)


def test_the_constant_of_a_free_running_sensor_is_none():
    assert constant_gap_ns(ticks(10.03, 0), ticks(13, 5)) == 0
    assert constant_gap_ns(np.zeros(0, np.int64), ticks(13, 5)) == 0
    assert constant_gap_ns(ticks(10, 0), ticks(10, 5)[:1]) == 0


def test_a_drive_ends_where_the_log_changes_or_ten_seconds_pass():
    second = 10**9
    stamps_ns = np.array([0, 1, 11, 22, 23, 24]) * second
    logs, drives = np.array([0, 0, 0, 0, 0, 1]), np.array([0, 0, 0, 1, 1, 2])
    mixed = np.array([3, 0, 5, 4, 1, 2])
    assert number_drives(stamps_ns[mixed], logs[mixed].tolist()).tolist() == drives[mixed].tolist()
    assert number_drives(stamps_ns[:0], []).tolist() == []

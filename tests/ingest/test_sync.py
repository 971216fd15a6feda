"""Trios by stamps alone: within the gate, one to one, each sweep accounted for."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.ingest.sync import first_occurrences, match_nearest, match_trios, number_drives

stamps = st.lists(st.integers(0, 400), max_size=30).map(lambda v: np.array(v, np.int64))
GATE = 7


@settings(max_examples=200, deadline=None)
@given(stamps, stamps, stamps)
def test_trios_lie_within_the_gate_are_one_to_one_and_no_sweep_is_lost(lidar, camera, radar):
    trios = match_trios(lidar, camera, radar, GATE)
    for own, stamps_ns in ((trios.lidar, lidar), (trios.camera, camera), (trios.radar, radar)):
        assert len(set(stamps_ns[own])) == len(own)
    together = np.stack([lidar[trios.lidar], camera[trios.camera], radar[trios.radar]])
    assert together.size == 0 or np.ptp(together, axis=0).max() <= GATE
    assert np.all(np.diff(lidar[trios.lidar]) > 0)
    assert len(trios.lidar) + sum(trios.rejected.values()) == len(lidar)


@settings(max_examples=100, deadline=None)
@given(stamps, stamps, stamps, st.integers(0, 100))
def test_the_order_of_logging_does_not_matter(lidar, camera, radar, seed):
    rng = np.random.default_rng(seed)
    mixed = [rng.permutation(s) for s in (lidar, camera, radar)]
    a, b = match_trios(lidar, camera, radar, GATE), match_trios(*mixed, GATE)
    assert lidar[a.lidar].tolist() == mixed[0][b.lidar].tolist()
    assert camera[a.camera].tolist() == mixed[1][b.camera].tolist()
    assert radar[a.radar].tolist() == mixed[2][b.radar].tolist()
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
    ms = 1_000_000
    lidar, camera = np.array([0]), np.array([3 * ms])
    assert len(match_trios(lidar, camera, np.array([-2 * ms]), 5 * ms).lidar) == 1
    apart = match_trios(lidar, camera, np.array([-2 * ms - 1]), 5 * ms)
    assert dict(apart.rejected) == {"camera_radar_outside_gate": 1}


def test_reasons_name_the_sensor_that_is_missing():
    sweeps = np.arange(5) * 100
    assert dict(match_trios(sweeps, sweeps[1:], sweeps[:3], 7).rejected) == {
        "no_camera_in_gate": 1,
        "no_radar_in_gate": 2,
    }


def test_a_drive_ends_where_the_log_changes_or_ten_seconds_pass():
    second = 10**9
    stamps_ns = np.array([0, 1, 11, 22, 23, 24]) * second
    assert number_drives(stamps_ns.tolist(), [0, 0, 0, 0, 0, 1]).tolist() == [0, 0, 0, 1, 1, 2]
    assert number_drives([], []).tolist() == []

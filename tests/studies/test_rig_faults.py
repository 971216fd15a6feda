"""What the study of faults on rigs of many sensors counts as wrong, and that what it remembers changes nothing."""

import types

import numpy as np
import pytest

from pipeline.errors import SolveError
from tests.benchmarks.studies.rig_faults import CASES, OF_KIND, REMEMBERED, Remembered, is_wrong, summary


def row(**told):
    off = {"az_deg": 0.3, "el_deg": 0.0, "az_sigma_deg": 0.05, "el_sigma_deg": 0.05, "limit_deg": [0.2, 0.2]}
    return (
        {"kind": "camera", "status": "accepted", "determined": ["azimuth"], "chi2_per_dof": 1.0, "faults": []}
        | off
        | told
    )


def test_a_pose_is_wrong_where_a_direction_that_it_certifies_lies_beyond_its_limit():
    assert is_wrong(row())
    assert not is_wrong(row(status="held"))
    assert not is_wrong(row(az_deg=0.19))
    assert not is_wrong(row(determined=["elevation"]))


def test_a_function_that_remembers_draws_and_fails_as_it_does_itself():
    calls = []

    def draw(size, rng):
        calls.append(size)
        if size < 0:
            raise SolveError("none")
        return rng.random(size)

    room = types.SimpleNamespace(draw=draw)
    Remembered(room, "draw")
    once, again = np.random.default_rng(4), np.random.default_rng(4)
    first = [room.draw(3, once), room.draw(2, once)]
    second = [room.draw(3, again), room.draw(2, again)]
    np.testing.assert_array_equal(np.concatenate(first), np.concatenate(second))
    assert calls == [3, 2]
    for _ in range(2):
        with pytest.raises(SolveError, match="none"):
            room.draw(-1, once)
    assert calls == [3, 2, -1]


def test_a_function_that_remembers_tells_its_named_arguments_apart():
    room = types.SimpleNamespace(height=lambda z_m, *, above_m, below_m=0.0: z_m + above_m - below_m)
    Remembered(room, "height")
    assert [room.height(1.0, above_m=2.0), room.height(1.0, above_m=3.0)] == [3.0, 4.0]
    assert room.height(1.0, below_m=2.0, above_m=2.0) == room.height(1.0, above_m=2.0, below_m=2.0) == 1.0


def test_a_table_counts_sensor_days_and_what_is_wrong():
    poses = {"left": row(), "base": row(kind="base", az_deg=0.1, off=[0.001, 0, 0, 0, 0, 0.01])}
    poses = {name: {**p, "edges": ["left-top"], "wrong": is_wrong(p)} for name, p in poses.items()}
    line = {
        "seed": 1,
        "case": "good",
        "sensor": "",
        "poses": poses,
        "edges": {"left-top": poses["left"]},
        "memory_gb": 1.0,
    }
    text = summary([line])
    assert "2 sensor-days of 1 van-days" in text
    assert "wrong **1 of 2" in text
    assert "| good | 1 |  | 2 | 1 | 1 | 1 |" in text


def test_each_kind_of_sensor_has_each_kind_of_fault():
    for what in ("turned at noon", "turned before", "silent", "late", "prior of"):
        assert {case.kind for case in CASES if what in case.name} == set(OF_KIND)


def test_what_is_remembered_is_what_stages_call():
    assert all(callable(getattr(room, name)) for room, names in REMEMBERED.items() for name in names)

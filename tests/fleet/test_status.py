"""How a vehicle-day stands, from what its stages said."""

import itertools

import pytest

from pipeline.fleet.status import day_statuses, night_word
from schemas.outcomes import OutcomeRow

CLOCK = itertools.count()


def row(vehicle, day, stage, status="done", method="", reason="", **values):
    stamp = f"2026-04-01T00:00:{next(CLOCK):02d}.000000Z"
    method = "joint" if stage == "calibrate" and not method else method
    given = {"method": method, "status": status, "reason": reason, "work_key": "key", "asserted_at": stamp}
    return OutcomeRow(vehicle=vehicle, day=day, stage=stage, **given, **values)


def statuses(*rows):
    return {(s.vehicle, s.day, s.method): (s.status, s.reason) for s in day_statuses(rows)}


def test_a_day_is_what_its_calibration_says():
    found = statuses(
        row("a", "d1", "ingest"), row("a", "d1", "calibrate", kept={"accepted": 3, "held": 0}),
        row("b", "d1", "calibrate", kept={"accepted": 2, "held": 1}, reason="lidar_radar: too wide"),
        row("c", "d1", "ingest", "refused", reason="no image"),
        row("c", "d1", "calibrate", "refused", reason="ingest: no image"),
        row("d", "d1", "calibrate", kept={"accepted": 2, "refused": 1}),
        row("e", "d1", "calibrate", kept={"accepted": 0, "held": 1, "refused": 2}),
    )  # fmt: skip
    assert found == {
        ("a", "d1", "joint"): ("done", ""),
        ("b", "d1", "joint"): ("partly", "lidar_radar: too wide"),
        ("c", "d1", "joint"): ("refused", "no image"),
        ("d", "d1", "joint"): ("partly", ""),
        ("e", "d1", "joint"): ("held", ""),
    }


def test_what_failed_last_is_failed_until_it_succeeds():
    rows = [
        row("a", "d1", "calibrate", kept={"accepted": 3}),
        row("a", "d1", "ingest", "failed", reason="disk full"),
    ]
    assert statuses(*rows) == {("a", "d1", "joint"): ("failed", "disk full")}
    assert statuses(*rows, row("a", "d1", "ingest")) == {("a", "d1", "joint"): ("done", "")}


def test_a_vehicle_that_others_drove_without_and_a_night_that_ended_early_are_missing():
    found = statuses(row("a", "d1", "calibrate"), row("b", "d2", "ingest"))
    assert found["b", "d1", ""][0] == "missing"
    assert "no logs" in found["b", "d1", ""][1]
    assert found["b", "d2", ""] == ("missing", "the night ended after ingest, before calibrate")


def test_methods_stand_apart_and_efforts_add_up():
    [joint, ssl] = day_statuses([
        row("a", "d1", "ingest", seconds=2.0, bytes_read=5),
        row("a", "d1", "calibrate", seconds=3.0, bytes_read=7),
        row("a", "d1", "calibrate", method="joint-ssl", status="refused", seconds=1.0),
    ])  # fmt: skip
    assert (joint.method, joint.status, joint.seconds, joint.bytes_read) == ("joint", "done", 5.0, 12)
    assert (ssl.method, ssl.status, ssl.seconds, ssl.bytes_read) == ("joint-ssl", "refused", 3.0, 5)
    assert joint.bytes_written is None


def test_a_vehicle_day_counts_once_by_the_method_that_is_asked_for():
    rows = [
        row("a", "d1", "calibrate", kept={"accepted": 3}),
        row("a", "d1", "calibrate", method="joint-ssl", kept={"held": 3}),
        row("b", "d1", "ingest"), row("b", "d1", "calibrate", method="joint-ssl"),
    ]  # fmt: skip
    assert len(day_statuses(rows)) == 3
    assert [(s.vehicle, s.status) for s in day_statuses(rows, "joint")] == [("a", "done"), ("b", "missing")]
    assert [s.status for s in day_statuses(rows, "joint-ssl")] == ["held", "done"]


@pytest.mark.parametrize(
    ("days", "word"),
    [
        (["done", "partly"], "partly"), (["partly"], "partly"), (["cached", "held"], "partly"),
        (["held", "held"], "held"), (["refused"], "refused"), (["done", "cached"], "incomplete"),
    ],
)  # fmt: skip
def test_the_word_of_a_night_is_that_of_its_days_if_they_agree(days, word):
    assert night_word(days) == word

"""What a vehicle-day's stages answer, and what the night makes of it. tests/end_to_end runs the real stages."""

from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.config import FleetConfig
from pipeline.errors import ConfigError, LogError
from pipeline.fleet.nightly import Night, run_night
from pipeline.fleet.pattern import VehicleDay
from pipeline.results import Outcome
from pipeline.runner import Stage
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_records, write_records
from schemas.calibrations import CALIBRATIONS, FRAMES_OF_PAIR, PAIRS, CalibrationRecord

DAY = "2026-03-02"
FLEET = FleetConfig.model_validate(
    {
        "fleet": {"name": "test"},
        "rigs": {
            "default": {
                "camera": {
                    "image": "/i",
                    "info": "/k",
                    "semantics": {"source": "topics", "labels": "/l", "detections": "/d"},
                },
                "lidar": {"points": "/p"},
                "radar": {"points": "/r"},
            }
        },
        "vehicles": {"car": {}, "bus": {}},
    }
)


class StagesThatSay:
    """Stages whose answers a test dictates: a status, or an error to raise."""

    def __init__(self, monkeypatch, lake, **answers):
        self.lake, self.answers, self.called = lake, answers, []
        real = Stage.run
        # What a refused day's records are made by is no stage that a test dictates.
        monkeypatch.setattr(Stage, "run", lambda s, task: real(s, task) if task.given else self.run(s, task))

    def run(self, stage, task):
        task.progress(0, 1, "begin")
        return self.answer(stage.name, task.partition)

    def answer(self, name, partition):
        self.called.append((name, partition.vehicle))
        answer = self.answers.get(name, "done")
        if isinstance(answer, Exception):
            raise answer
        if name == "calibrate":
            status = "cached" if answer == "cached" else "refused" if answer == "refused" else "done"
            rows = self.record(partition, answer)
            return Outcome(name, partition.vehicle, partition.day, status, "key", records=tuple(rows))
        return Outcome(name, partition.vehicle, partition.day, answer, "key", rows=7, reason="no frame")

    def record(self, partition, answer):
        statuses = {"held": ["accepted", "held", "accepted"], "refused": ["refused"] * 3}
        rows = [
            CalibrationRecord(
                partition.vehicle,
                partition.day,
                "joint",
                pair,
                *FRAMES_OF_PAIR[pair],
                status,
                "",
                "key",
                "0",
                0,
            )
            for pair, status in zip(PAIRS, statuses.get(answer, ["accepted"] * 3), strict=True)
        ]
        write_records(self.lake, CALIBRATIONS, partition, rows, "key", "0")
        return rows


@pytest.fixture
def night(tmp_path):
    return Night(FLEET, Lake.at(tmp_path / "lake"))


def outcomes(night, vehicles=("car",), watch=lambda *_: None):
    days = [VehicleDay(Partition(v, DAY), (Path("a.mcap"),)) for v in vehicles]
    return {o.vehicle: o for o in run_night(night, days, "inline", 1, watch)}


def records(night):
    return read_records(night.lake, CALIBRATIONS, CalibrationRecord)


@pytest.mark.parametrize(
    ("answers", "status", "pairs"),
    [
        ({}, "done", "accepted"),
        ({"ingest": "cached", "perceive": "cached", "calibrate": "cached"}, "cached", "accepted"),
        ({"ingest": "cached", "perceive": "cached"}, "done", "accepted"),
        ({"calibrate": "held"}, "held", "held"),
        ({"calibrate": "refused"}, "refused", "refused"),
    ],
)
def test_a_day_that_reaches_calibrate_has_the_status_of_its_records(
    answers, status, pairs, night, monkeypatch
):
    StagesThatSay(monkeypatch, night.lake, **answers)
    outcome = outcomes(night)["car"]
    assert outcome.status == status
    assert pairs in outcome.pairs.values()
    assert outcome.frames == 7


@pytest.mark.parametrize("stage", ["ingest", "perceive"])
def test_a_refused_day_leaves_refused_records_with_the_reason(stage, night, monkeypatch):
    script = StagesThatSay(monkeypatch, night.lake, **{stage: "refused"})
    for _ in range(2):  # again: the same refusal is the same record
        outcome = outcomes(night)["car"]
        assert (outcome.status, outcome.reason) == ("refused", "no frame")
    assert ("calibrate", "car") not in script.called
    assert {(r.pair, r.status, r.reason) for r in records(night)} == {
        (pair, "refused", f"{stage}: no frame") for pair in PAIRS
    }
    assert len(records(night)) == 3


@pytest.mark.parametrize("error", [LogError("a.mcap", "is empty"), OSError(28, "No space left on device")])
def test_an_error_fails_its_own_day_only_and_is_not_recorded(error, night, monkeypatch):
    StagesThatSay(monkeypatch, night.lake, perceive=error)
    found = outcomes(night, ("car", "bus"))
    assert {o.status for o in found.values()} == {"failed"}
    assert str(error) in found["car"].reason
    assert found["car"].stages == {"ingest": "done", "perceive": "failed"}
    assert records(night) == []


def test_a_surprise_fails_its_day_with_a_traceback(night, monkeypatch):
    StagesThatSay(monkeypatch, night.lake, calibrate=ZeroDivisionError("x"))
    outcome = outcomes(night)["car"]
    assert (outcome.status, outcome.reason) == ("failed", "ZeroDivisionError: x")
    assert "Traceback" in outcome.trace


def test_unknown_vehicles_are_refused_and_the_others_go_on(night, monkeypatch):
    script = StagesThatSay(monkeypatch, night.lake)
    found = outcomes(night, ("tram", "car"))
    assert found["tram"].status == "refused"
    assert "tram" in found["tram"].reason
    assert "fleet.toml" in found["tram"].reason
    assert found["car"].status == "done"
    assert {vehicle for _, vehicle in script.called} == {"car"}


def test_progress_says_which_stage_of_which_day(night, monkeypatch):
    StagesThatSay(monkeypatch, night.lake)
    seen = []
    outcomes(night, ("tram", "car"), watch=lambda *at: seen.append(at))
    assert seen == [(0, 0, 1, "ingest begin"), (0, 0, 1, "perceive begin"), (0, 0, 1, "calibrate begin")]


def test_a_wrong_configuration_fails_the_day_that_shows_it(night, monkeypatch):
    StagesThatSay(
        monkeypatch, night.lake, ingest=ConfigError("prior.json", "T_camera_lidar", "is no transform")
    )
    assert outcomes(replace(night, seed=3))["car"].reason == "prior.json: T_camera_lidar: is no transform"

"""What a vehicle-day's stages answer, and what the night makes of it. tests/end_to_end runs the real stages."""

from dataclasses import replace
from pathlib import Path

import pytest

import pipeline.fleet.ledger
from pipeline.core.config import FleetConfig
from pipeline.core.errors import CollectedError, ConfigError, DamagedError, LogError
from pipeline.core.results import Outcome
from pipeline.core.runner import Stage
from pipeline.fleet.nightly import Night, run_night
from pipeline.fleet.pattern import VehicleDay
from pipeline.fleet.status import night_statuses
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, FRAMES_OF_PAIR, PAIRS, CalibrationRecord
from schemas.outcomes import OUTCOMES, OutcomeRow
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.lakes import write_records

DAY = "2026-03-02"
FLEET = FleetConfig.model_validate(
    {"fleet": {"name": "test"}, "rigs": {"default": THREE_SENSORS}, "vehicles": {"car": {}, "bus": {}}}
)


def record_of(pair, status, reason="", vehicle="car"):
    parent, child = FRAMES_OF_PAIR[pair]
    return CalibrationRecord(
        vehicle=vehicle, day=DAY, method="joint", pair=pair, parent_frame=parent, child_frame=child,
        status=status, reason=reason, work_key="key", code_version="0", seed=0,
    )  # fmt: skip


class StagesThatSay:
    """Stages whose answers a test dictates: a status, or an error to raise."""

    def __init__(self, monkeypatch, lake, **answers):
        self.lake, self.answers, self.called, self.recorded = lake, answers, [], ()
        real = Stage.run
        # What a refused day's records are made by is no stage that a test dictates.
        monkeypatch.setattr(Stage, "run", lambda s, task: real(s, task) if task.given else self.run(s, task))

    def run(self, stage, task):
        task.progress(0, 1, "begin")
        self.recorded = task.recorded
        return self.answer(stage.name, task.partition)

    def answer(self, name, partition):
        self.called.append((name, partition.vehicle))
        answer = self.answers.get(name, "done")
        if isinstance(answer, Exception):
            raise answer
        if name == "calibrate":
            status = "cached" if answer == "cached" else "refused" if answer == "refused" else "done"
            rows = self.record(partition, answer)
            kept = {s: sum(r.status == s for r in rows) for s in ("accepted", "held", "refused")}
            records = tuple(rows)
            return Outcome(name, partition.vehicle, partition.day, status, "key", kept=kept, records=records)
        return Outcome(name, partition.vehicle, partition.day, answer, "key", rows=7, reason="no frame")

    def record(self, partition, answer):
        statuses = {
            "partly": ["accepted", "held", "accepted"],
            "held": ["held", "held", "refused"],
            "refused": ["refused"] * 3,
        }
        rows = [
            record_of(pair, status, vehicle=partition.vehicle)
            for pair, status in zip(PAIRS, statuses.get(answer, ["accepted"] * 3), strict=True)
        ]
        write_records(self.lake, CALIBRATIONS, rows, "key")
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
        ({"calibrate": "partly"}, "partly", "held"),
        ({"calibrate": "held"}, "held", "refused"),
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


def test_a_night_says_what_became_of_each_stage_and_a_second_one_adds_nothing(night, monkeypatch):
    script = StagesThatSay(monkeypatch, night.lake, perceive="cached", calibrate="held")
    outcomes(night, ("car", "bus"))
    rows = read_records(night.lake, OUTCOMES, OutcomeRow)
    assert {(r.vehicle, r.stage, r.method, r.status) for r in rows} == {
        (vehicle, stage, "joint" if stage == "calibrate" else "", "done")
        for vehicle in ("car", "bus")
        for stage in ("ingest", "perceive", "calibrate")
    }
    log = sorted((night.lake.root / "outcomes" / "_delta_log").iterdir())
    outcomes(night, ("car", "bus"))
    assert sorted((night.lake.root / "outcomes" / "_delta_log").iterdir()) == log
    assert len(script.recorded) == 3  # what the night's method has found is not read once more


def test_records_wait_for_a_storage_that_does_not_answer(night, monkeypatch):
    StagesThatSay(monkeypatch, night.lake)
    monkeypatch.setattr(pipeline.fleet.ledger, "_EVERY_S", 0.0)
    real, calls = pipeline.fleet.ledger.commit_records, []

    def failing(*arguments):
        calls.append(arguments)
        if len(calls) < 4:
            raise OSError("503")
        return real(*arguments)

    monkeypatch.setattr(pipeline.fleet.ledger, "commit_records", failing)
    assert outcomes(night, ("car", "bus"))["bus"].status == "done"
    assert len(read_records(night.lake, OUTCOMES, OutcomeRow)) == 6


@pytest.mark.parametrize("error", [LogError("a.mcap", "is empty"), OSError(28, "No space left on device")])
def test_an_error_fails_its_own_day_only_and_is_not_recorded(error, night, monkeypatch):
    StagesThatSay(monkeypatch, night.lake, perceive=error)
    found = outcomes(night, ("car", "bus"))
    assert {o.status for o in found.values()} == {"failed"}
    assert str(error) in found["car"].reason
    assert found["car"].stages == {"ingest": "done", "perceive": "failed"}
    assert records(night) == []


@pytest.mark.parametrize("error", [DamagedError, CollectedError])
def test_what_is_damaged_or_left_the_lake_is_set_aside_and_made_anew_at_once(error, night, monkeypatch):
    path = Path(night.lake.file("moments", Partition("car", DAY)))
    path.parent.mkdir(parents=True)
    path.write_bytes(b"damaged")
    script = StagesThatSay(monkeypatch, night.lake)
    answer = script.answer

    def stumbling(name, partition):
        if name == "perceive" and path.exists():
            script.called.append((name, partition.vehicle))
            raise error(str(path), "2026-04-01")
        return answer(name, partition)

    script.answer = stumbling
    assert outcomes(night)["car"].status == "done"
    stages = [name for name, _ in script.called]
    assert stages == ["ingest", "perceive", "ingest", "perceive", "calibrate"]
    assert [p.name for p in path.parent.iterdir()] == ["part-0.parquet.damaged"]


def test_a_wrong_configuration_fails_the_day_that_shows_it(night, monkeypatch):
    StagesThatSay(
        monkeypatch, night.lake, ingest=ConfigError("prior.json", "T_camera_lidar", "is no transform")
    )
    car = outcomes(replace(night, seed=3))["car"]
    assert car.reason == car.mend == "prior.json: T_camera_lidar: is no transform"
    assert night_statuses([car], night.fleet) == ["misconfigured"]


@pytest.mark.parametrize(("faults", "is_one"), [(("configuration",), True), ((), False)])
def test_a_refusal_is_one_of_the_configuration_by_its_fault_and_not_by_its_words(
    faults, is_one, night, monkeypatch
):
    def say(stage, task):
        of = (stage.name, task.partition.vehicle, task.partition.day)
        return Outcome(*of, "refused", "key", reason="mend the topics in fleet.toml", faults=faults)

    real = Stage.run
    monkeypatch.setattr(Stage, "run", lambda s, task: real(s, task) if task.given else say(s, task))
    car = outcomes(night)["car"]
    assert (car.status, car.mend) == ("refused", car.reason if is_one else "")
    assert [r.faults for r in records(night)] == [list(faults)] * 3
    [row] = [r for r in read_records(night.lake, OUTCOMES, OutcomeRow) if r.stage == "ingest"]
    assert row.faults == list(faults)

"""A long day that lacks frames is read wider, and only such a one; what was read wider counts as read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.calibrate.verify.edge_result import EdgeResult
from pipeline.calibrate.verify.held_out import HeldOutTest
from pipeline.calibrate.verify.target_accuracy import Claim
from pipeline.calibrate.verify.verdict import Evidence, judge
from pipeline.core.config import ChecksConfig
from pipeline.core.results import Effort, Outcome
from pipeline.core.runner import Stage, why_to_run
from pipeline.core.sections import SearchRange
from pipeline.core.stage_work import Task
from pipeline.core.stages import INGEST
from pipeline.fleet.nightly import Night, asks_for_more, run_night
from pipeline.fleet.pattern import VehicleDay
from pipeline.rig.targets import DEFAULT_TARGETS
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import PAIRS
from schemas.moments import SWEEPS_LOGGED, SWEEPS_PLANNED
from tests.fleet.test_nightly import DAY, FLEET, record_of
from tests.makers.written_logs import Kit, fleet_config

RESULT = EdgeResult(
    "lidar_radar", np.eye(4), np.eye(6) * 1e-6, np.ones(6, bool), np.eye(4), np.full(6, 0.03), 50,
    SearchRange(0.1, 0.3), DEFAULT_TARGETS,
)  # fmt: skip
VAGUE, SURE = (Claim(sigma, 0.0, 0.0, sigma, 0.003, 0.995) for sigma in (0.01, 1e-4))


def held_for(claim, frames):
    """The reason of a verdict on a result that is right but for what is given."""
    evidence = Evidence(HeldOutTest(1.0, 0.8, 0.02, frames, 10), {"azimuth": claim})
    found = judge(RESULT, evidence, ChecksConfig())
    assert found.status == "held"
    return found.reason


UNSURE, FEW_HELD_OUT = held_for(VAGUE, 20), held_for(SURE, 1)
MOVED = "yaw moved by 5.0 sigmas of the prior"


def results(reason, logged=36000, planned=400, ingest="done"):
    kept = {SWEEPS_LOGGED: logged, SWEEPS_PLANNED: planned} if logged else {}
    records = [record_of(pair, "accepted", "") for pair in PAIRS]
    records[0] = record_of(PAIRS[0], "held" if reason else "accepted", reason)
    return [
        Outcome("ingest", "car", DAY, ingest, "i", rows=7, kept=kept),
        Outcome("calibrate", "car", DAY, "done", "c", records=tuple(records)),
    ]


def test_more_is_read_where_frames_are_lacking_and_sweeps_lie_unread():
    assert asks_for_more(results(UNSURE))
    assert asks_for_more(results(FEW_HELD_OUT))
    assert asks_for_more(results("", ingest="refused"))
    for reason in ("", MOVED, f"{MOVED}; {UNSURE}", "not triggered: the prior stays"):
        assert not asks_for_more(results(reason))
    assert not asks_for_more(results(UNSURE, logged=None))  # read whole
    assert not asks_for_more(results(UNSURE, logged=400))
    assert not asks_for_more([*results(UNSURE), Outcome("perceive", "car", DAY, "failed", "")])


def night_of(monkeypatch, tmp_path, enough):
    """A night whose day is accepted once so many sweeps were read; budgets that ingest was asked for."""
    asked = []

    def run(stage, task):
        budget = task.fleet.ingest.read_sweeps
        spent = Effort("", 1.0, 10, None)
        found = [
            replace(r, effort=spent) for r in results("" if budget >= enough else UNSURE, planned=budget)
        ]
        if stage is INGEST:
            asked.append(budget)
            return found[0]
        return found[1] if stage.name == "calibrate" else replace(found[0], stage="perceive", kept={})

    monkeypatch.setattr(Stage, "run", run)
    days = [VehicleDay(Partition("car", DAY), (Path("a.mcap"),))]
    [outcome] = run_night(Night(FLEET, Lake.at(tmp_path)), days, "inline", 1, lambda *_: None)
    return outcome, asked


@pytest.mark.parametrize(("enough", "asked"), [(400, [400]), (700, [400, 800]), (10**9, [400, 800, 1600])])
def test_a_night_doubles_what_is_read_until_it_is_enough_and_not_for_ever(
    enough, asked, monkeypatch, tmp_path
):
    outcome, budgets = night_of(monkeypatch, tmp_path, enough)
    assert budgets == asked
    assert outcome.status == ("done" if enough <= 1600 else "partly")
    # Results are of the last pass: one record per pair becomes current; their efforts are of all passes.
    passes = len(asked)
    efforts = [(r.effort.seconds, r.effort.bytes_read, r.effort.bytes_written) for r in outcome.results]
    assert efforts == [(passes, 10 * passes, None)] * 3


def test_a_day_that_was_read_wider_is_up_to_date_and_one_that_was_read_less_is_not(tmp_path):
    log = Kit(frames=120).drive().mcap(tmp_path / "a.mcap")

    def task(sweeps):
        fleet = fleet_config(ingest={"read_sweeps": sweeps}).read_from(tmp_path / "fleet.toml")
        return Task(fleet, Lake.at(tmp_path / "lake"), Partition("car", "2023-11-14"), logs=(log,))

    made = INGEST.run(task(80))
    assert (made.status, made.kept[SWEEPS_PLANNED]) == ("done", 80)
    for sweeps in (80, 40, 20):
        again = INGEST.run(task(sweeps))
        assert (again.status, again.work_key, again.rows) == ("cached", made.work_key, made.rows)
        assert why_to_run(INGEST, task(sweeps)) == ""
    assert why_to_run(INGEST, task(10)) == "other configuration"
    assert why_to_run(INGEST, task(160)) == "other configuration"
    assert INGEST.run(task(100)).status == "done"

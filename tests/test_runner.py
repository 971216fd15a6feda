"""Laws of the runner, and the contract that every stage keeps."""

import os
import pickle
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import pipeline.core.runner
import pipeline.store.tables
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError, ContractError, LogError
from pipeline.core.results import Outcome
from pipeline.core.runner import Stage, try_stage, why_to_run
from pipeline.core.stage_work import NothingUsable, Run, Task, Told, Window, Work
from pipeline.core.stages import CALIBRATE, PERCEIVE, PREPARE, REPORT, STAGES
from pipeline.fleet.ledger import outcome_row
from pipeline.learn.prepare.split import SplitPlan
from pipeline.report.stage import Pages
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.tables import read_manifest
from pipeline.store.views import observations_of, perceived
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from schemas.features import FEATURES
from schemas.moments import FILES, PERCEIVED
from tests.makers.fleet_files import fleet_toml
from tests.makers.lakes import joined_of, write_frames, write_observations
from tests.makers.solve_scenes import make_day

DAY = Partition("v", "2024-05-06")
WRITES = (PERCEIVED, *FEATURES.values())


@dataclass
class MadeUp:
    """A stage whose rows and settings a test dictates; `asked` counts how often its rows were asked for."""

    settings: dict
    rows: object
    extra: dict
    asked: int = 0

    def __call__(self, _task):
        def rows(run):
            self.asked += 1
            yield from self.rows(run)

        return Work((self.settings,), rows, **self.extra)


@pytest.fixture
def fleet(tmp_path):
    (tmp_path / "fleet.toml").write_text(fleet_toml("v"))
    return load_fleet(tmp_path / "fleet.toml")


@pytest.fixture
def task(fleet, tmp_path):
    return Task(fleet, Lake.at(tmp_path / "lake"), DAY)


@pytest.fixture
def stage(monkeypatch):
    """Observations out of nothing: `stage(rows, settings)`."""

    def make(rows, settings=None, writes=WRITES, **extra):
        made = MadeUp(settings or {}, rows, extra)
        monkeypatch.setattr(Stage, "load", lambda _: made)
        return Stage("made-up", (), writes, ""), made

    return make


def some(count):
    """Rows of that many frames."""
    return lambda _run: rows_of_day(count)


def rows_of_day(count):
    """Moments with the features of their sensors, as perceive has them."""
    return (joined_of(o) for o in make_day(count))


def kept(task):
    return [o.frame_index for o in observations_of(task.lake, DAY)]


def leftovers(task):
    return [p for p in task.lake.root.rglob("*") if p.is_file() and p.suffix != ".parquet"]


def test_the_same_key_is_done_once_and_other_settings_are_other_work(task, stage):
    first, made = stage(some(3), {"voxel_m": 0.25})
    done, again = first.run(task), first.run(task)
    assert (done.status, again.status, made.asked) == ("done", "cached", 1)
    assert replace(again, status="done") == done
    other, _ = stage(some(2), {"voxel_m": 0.5})
    assert other.run(task).work_key != done.work_key
    assert len(kept(task)) == 2


@pytest.mark.parametrize(
    "error", [LogError("a.mcap", "is empty"), OSError(28, "No space left"), KeyboardInterrupt()]
)
def test_a_stage_that_raises_leaves_what_was_there_and_nothing_else(error, task, stage):
    stage(some(2))[0].run(task)
    before = kept(task)

    def raising(_run):
        yield from rows_of_day(20)  # more than a row group: some of it is written already
        raise error

    with pytest.raises(type(error)):
        stage(raising, {"other": 1})[0].run(task)
    assert kept(task) == before
    assert leftovers(task) == []


_KILLED = """
import os, signal, sys
from pathlib import Path
from pipeline.core.config import load_fleet
from pipeline.core.runner import Stage
from pipeline.store.partitions import Lake, Partition
from pipeline.core.stage_work import Task, Work
from schemas.features import FEATURES
from schemas.moments import PERCEIVED
from tests.makers.lakes import joined_of
from tests.makers.solve_scenes import make_day

def rows(run):
    yield from map(joined_of, make_day(20))
    os.kill(os.getpid(), signal.SIGKILL)

Stage.load = lambda stage: lambda task: Work(({"killed": 1},), rows)
task = Task(load_fleet(Path(sys.argv[1])), Lake.at(sys.argv[2]), Partition("v", "2024-05-06"))
Stage("made-up", (), (PERCEIVED, *FEATURES.values()), "").run(task)
"""


def test_a_killed_run_leaves_the_old_partition_and_the_next_one_tidies_up(task, stage):
    stage(some(2))[0].run(task)
    before = kept(task)
    arguments = [sys.executable, "-c", _KILLED, task.fleet.file, task.lake.root]
    here = {"PYTHONPATH": str(Path(__file__).resolve().parent.parent)}
    killed = subprocess.run(arguments, env=os.environ | here, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert kept(task) == before
    assert leftovers(task)  # the dead could not tidy up
    stage(some(3), {"next": 1})[0].run(task)
    assert len(kept(task)) == 3
    assert leftovers(task) == []


def test_the_manifest_says_what_was_kept_and_left_out_and_so_does_the_outcome(task, stage):
    def rows(run):
        run.kept["night"] += 2
        run.rejected["dark"] += 3
        run.extra["grid"] = [1, 2]
        run.remarks = "one log ends early"
        yield from rows_of_day(2)

    outcome = stage(rows)[0].run(task)
    manifest = perceived(task.lake, DAY)
    assert manifest.rows == outcome.rows == 2
    assert manifest.kept == outcome.kept == {"frames": 2, "night": 2}
    assert manifest.rejected == outcome.rejected == {"dark": 3}
    files = {kind: table.name for kind, table in FEATURES.items()}
    assert manifest.extra == {"grid": [1, 2], FILES: files}
    assert manifest.work_key == outcome.work_key
    assert outcome.reason == "one log ends early"
    again = stage(rows)[0].run(task)  # a night that was killed may have told nobody
    assert (again.status, again.reason) == ("cached", "one log ends early")
    assert outcome.outputs == [str(task.lake.folder("perceived", DAY))]


def test_a_partition_without_a_row_is_refused_with_counted_reasons_also_from_the_cache(task, stage):
    def rows(run):
        run.rejected.update({"dark": 2, "bright": 1})
        yield from ()

    empty, _ = stage(rows, nothing="no usable frame")
    for outcome in (empty.run(task), empty.run(task)):
        assert (outcome.status, outcome.reason) == ("refused", "no usable frame: 1 bright, 2 dark")
    assert perceived(task.lake, DAY).rows == 0


def test_where_nothing_is_usable_nothing_is_written_and_the_day_is_refused(task, stage):
    stage(some(2))[0].run(task)

    def rows(run):
        run.rejected["damaged"] += 4
        raise NothingUsable("no usable message on /points")
        yield

    outcome = stage(rows, {"other": 1})[0].run(task)
    assert (outcome.status, outcome.rows, outcome.outputs) == ("refused", 0, [])
    assert (outcome.reason, outcome.rejected) == ("no usable message on /points", {"damaged": 4})
    assert len(kept(task)) == 2


def test_inputs_that_were_refused_are_not_worked_out_again_and_others_are(task, stage):
    def rows(_run):
        raise NothingUsable("no usable message on /points", "configuration")
        yield

    refusing, made = stage(rows)
    first = refusing.run(task)
    assert first.faults == ("configuration",)
    task = replace(task, before=[outcome_row(first, "")])
    again = refusing.run(task)
    assert (again, made.asked) == (first, 1)
    assert why_to_run(refusing, task) == ""
    other, made = stage(rows, {"voxel_m": 0.5})
    assert why_to_run(other, task) == "no perceived yet"
    assert (other.run(task).status, made.asked) == ("refused", 1)


def test_a_day_that_asks_for_more_memory_than_a_worker_may_take_is_refused_until_it_may_take_more(
    task, stage
):
    def with_bound(gigabytes):
        section = task.fleet.fleet.model_copy(update={"memory_gb": gigabytes})
        return replace(task, fleet=task.fleet.model_copy(update={"fleet": section}))

    def rows(_run):
        keep = [np.ones(1 << 22) for _ in range(16)]  # half a gigabyte
        yield from rows_of_day(len(keep))

    greedy, made = stage(rows)
    found = greedy.run(with_bound(0.2))
    assert (found.status, found.faults) == ("refused", ("memory",))
    assert "needed more than 0.2 GB of memory (fleet.memory_gb)" in found.reason
    assert perceived(task.lake, DAY) is None
    task = replace(task, before=[outcome_row(found, "")])
    assert (greedy.run(with_bound(0.2)).status, made.asked) == ("refused", 1)
    assert (greedy.run(with_bound(2.0)).status, made.asked) == ("done", 2)


@pytest.mark.parametrize(
    "damaged", [("perceived", DAY), ("scan_features", DAY, "radar")], ids=["moments", "a sensor's file"]
)
def test_a_damaged_partition_is_made_anew(damaged, task, stage):
    made_up, made = stage(some(2))
    made_up.run(task)
    file = task.lake.file(*damaged)
    file.write_bytes(file.read_bytes()[:-20])
    assert made_up.run(task).status == "done"
    assert made.asked == 2


def record(work_key):
    return CalibrationRecord(
        vehicle=DAY.vehicle, day=DAY.day, method="joint", pair=PAIRS[0], parent_frame="camera", child_frame="lidar",
        status="held", reason="", work_key=work_key, code_version="0", seed=0,
    )  # fmt: skip


@pytest.mark.parametrize("again", [False, True])
def test_records_are_added_once_unless_they_shall_become_current_again(again, task, stage):
    def rows(run):
        yield record(run.work_key)

    told = {"tell": lambda rows: Told({"held": len(rows)}, reason="close"), "again": again}
    recording, made = stage(rows, writes=(CALIBRATIONS,), **told)
    first, second = recording.run(task), recording.run(task)
    assert (first.status, second.status) == ("done", "done" if again else "cached")
    assert made.asked == (2 if again else 1)
    for outcome in (first, second):
        assert (outcome.kept, outcome.reason, outcome.rows) == ({"held": 1}, "close", 1)
        assert outcome.records[0].work_key == outcome.work_key
        assert [Path(p).exists() for p in outcome.outputs] == [True]
    assert len(read_records(task.lake, CALIBRATIONS, CalibrationRecord)) == 1


def test_errors_that_a_user_can_act_on_become_failed_outcomes_and_others_do_not(task, stage):
    def failing(error):
        def rows(_run):
            raise error
            yield

        return try_stage(stage(rows)[0], task, lambda *_: None)

    outcome = failing(LogError("a.mcap", "is empty"))
    assert (outcome.status, outcome.vehicle, outcome.day) == ("failed", "v", DAY.day)
    assert "a.mcap" in outcome.reason
    assert outcome.faults == ()
    assert failing(ConfigError("fleet.toml", "rigs", "are wrong")).faults == ("configuration",)
    with pytest.raises(ZeroDivisionError):
        failing(ZeroDivisionError())


# --- what is true of every stage of the list


def task_of(stage, fleet, lake, tmp_path):
    """A task that the stage could do, had the lake anything."""
    given = {PREPARE: SplitPlan((), {}), REPORT: Pages(tmp_path / "pages" / "fleet.html")}.get(stage)
    of = DAY if stage.per_vehicle_day else Window("2024-05-01", "2024-05-31")
    return Task(fleet, lake, of, given=given)


@pytest.mark.parametrize("stage", STAGES, ids=lambda s: s.name)
def test_every_stage_takes_a_task_and_answers_with_an_outcome_or_a_plain_error(stage, fleet, tmp_path):
    lake = Lake.at(tmp_path / "lake")
    task = task_of(stage, fleet, lake, tmp_path)
    assert pickle.loads(pickle.dumps(stage)) == stage  # workers are sent it
    if stage in (PERCEIVE, PREPARE):
        with pytest.raises(ContractError, match=r"run `boresight ingest` first"):
            stage.run(task)
        assert not lake.root.exists()
        return
    outcome = stage.run(task)
    assert isinstance(outcome, Outcome)
    assert outcome.stage == stage.name
    assert (outcome.vehicle, outcome.day) == (("v", DAY.day) if stage.per_vehicle_day else ("", ""))
    # Nothing but the pages of an empty fleet can be made of an empty lake.
    assert outcome.status == ("done" if stage is REPORT else "refused")
    assert outcome.reason or stage is REPORT


@pytest.mark.parametrize("stage", [s for s in STAGES if s.per_vehicle_day], ids=lambda s: s.name)
def test_every_stage_of_a_vehicle_day_refuses_vehicles_that_the_file_does_not_name(stage, fleet, tmp_path):
    task = replace(task_of(stage, fleet, Lake.at(tmp_path / "lake"), tmp_path), of=Partition("tram", DAY.day))
    with pytest.raises(ConfigError, match=r"fleet\.toml: vehicles\.tram: unknown vehicle"):
        stage.run(task)


@pytest.mark.parametrize("stage", STAGES, ids=lambda s: s.name)
def test_every_stage_names_settings_that_can_be_hashed_and_rows_that_wait_to_be_asked(stage, fleet, tmp_path):
    lake = Lake.at(tmp_path / "lake")
    write_frames(lake, DAY, [])
    write_observations(lake, DAY, [])
    task = task_of(stage, fleet, lake, tmp_path)
    if stage.per_vehicle_day:
        found = {s.name: read_manifest(lake, s, DAY) for s in stage.reads if not s.of_sensor}
        task = replace(task, inputs=found)
    files = sorted(lake.root.rglob("*"))
    works = [stage.load()(task) for _ in range(2)]
    keys = [pipeline.core.runner.config_hash(*w.settings) for w in works]
    assert keys[0] == keys[1]
    assert isinstance(works[0], Work)
    works[0].rows(Run("key", (), task.progress))  # not asked for a row, it does nothing
    assert sorted(lake.root.rglob("*")) == files


def test_refused_days_are_recorded_by_calibrate_with_the_reason_of_the_stage_that_refused(task):
    refused = Outcome("ingest", DAY.vehicle, DAY.day, "refused", "ingest-key", reason="no image")
    for _ in range(2):
        outcome = CALIBRATE.run(replace(task, given=refused, method="tracking"))
        assert (outcome.status, outcome.kept["refused"]) == ("refused", 3)
    found = read_records(task.lake, CALIBRATIONS, CalibrationRecord)
    assert {(r.method, r.status, r.reason) for r in found} == {("tracking", "refused", "ingest: no image")}
    assert [r.inputs for r in found] == [["ingest-key"]] * 3

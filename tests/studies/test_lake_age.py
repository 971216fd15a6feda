"""The fleet that study lake_age makes by algebra."""

import datetime as dt

from pipeline.stage_work import Task, Window
from pipeline.stages import AUDIT
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS, PAIRS
from schemas.drift import DRIFT
from schemas.outcomes import OUTCOMES
from schemas.states import STATES
from tests.makers.fleet_lakes import FleetHistory, one_rig_fleet


def test_the_made_fleet_is_audited_as_it_was_made_and_every_table_has_its_rows(tmp_path):
    lake, history = Lake.at(tmp_path), FleetHistory(12, 16, dt.date(2026, 3, 1))
    for day in range(16):
        history.commit(lake, CALIBRATIONS, day)
    found = AUDIT.run(Task(one_rig_fleet(), lake, Window())).records
    assert {f.vehicle for f in found if f.status == "RED"} == {"vehicle-00007"}
    assert {f.moved_sensor for f in found if f.status == "RED"} == {"radar"}
    each = {s.name: history.rows(s, 15).num_rows / 12 for s in (CALIBRATIONS, OUTCOMES, DRIFT, STATES)}
    assert each == {"calibrations": len(PAIRS), "outcomes": 3, "drift": 18, "states": 3}
    larger = FleetHistory(60, 40)  # of which some join later
    assert larger.rows(CALIBRATIONS, 3).num_rows < 60 * len(PAIRS) == larger.rows(CALIBRATIONS, 39).num_rows

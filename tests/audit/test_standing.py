"""With fewer records no verdict gets better: what the last audit said stands, with the reason."""

import json
from pathlib import Path

import numpy as np
import pytest

from jobs.service import service
from jobs.state import state
from jobs.status import status
from pipeline.core.errors import DamagedLogError
from pipeline.fleet.ledger import Ledger
from pipeline.store.commits import commit_records
from pipeline.store.delta import live_files, open_table
from pipeline.store.partitions import Lake
from pipeline.store.repair import repair_table
from schemas.calibrations import CALIBRATIONS
from tests.audit.fleet_records import vehicle_records
from tests.audit.test_audit_fleet import knocked
from tests.makers.commands import command
from tests.makers.fleet_files import fleet_toml


@pytest.fixture
def files(tmp_path):
    """fleet.toml and a lake of two vehicles, a commit each; the radar of "v" is knocked on the eleventh day."""
    lake, rng = Lake.at(tmp_path / "lake"), np.random.default_rng(22)
    commit_records(lake, CALIBRATIONS, vehicle_records("v", 20, rng, motion=knocked(10)))
    commit_records(lake, CALIBRATIONS, vehicle_records("w", 20, rng))
    (tmp_path / "fleet.toml").write_text(fleet_toml("v", "w"))
    return tmp_path / "fleet.toml", tmp_path / "lake"


def audited(files, capsys):
    return command(capsys, "audit", "--fleet", files[0], "--lake", files[1])[:2]


def lose(lake: Path, vehicle: str) -> tuple[Path, bytes]:
    """Take the file of a vehicle's calibrations away."""
    table = open_table(Lake.at(lake), CALIBRATIONS)
    assert table is not None
    [name] = [f.name for f in live_files(table) if f.vehicles == (vehicle, vehicle)]
    path = lake / "calibrations" / name
    content = path.read_bytes()
    path.unlink()
    return path, content


def test_a_red_vehicle_whose_records_are_lost_stays_red_with_the_reason_until_they_are_back(files, capsys):
    code, whole = audited(files, capsys)
    assert (code, whole["statuses"]) == (0, {"RED": 1, "YELLOW": 0, "UNKNOWN": 0, "GREEN": 1})
    path, content = lose(files[1], "v")
    for _ in range(2):  # also of what was kept before
        code, summary = audited(files, capsys)
        assert (code, summary["status"]) == (3, "incomplete")
        assert path.name in summary["damaged"][0]
        assert (summary["statuses"], summary["moved"]) == (whole["statuses"], whole["moved"])
    capsys.readouterr()
    assert status(lake=str(files[1]), json=True) == 0  # what it reads is whole
    assert json.loads(capsys.readouterr().out)["statuses"] == whole["statuses"]
    assert state(lake=str(files[1]), vehicle="v", json=True) == 0
    path.write_bytes(content)
    code, summary = audited(files, capsys)
    assert (code, summary["statuses"], summary["damaged"]) == (0, whole["statuses"], [])


def test_a_green_vehicle_is_not_called_green_on_what_cannot_be_read(files, capsys):
    audited(files, capsys)
    lose(files[1], "w")
    summary = audited(files, capsys)[1]
    assert summary["statuses"] == {"RED": 1, "YELLOW": 0, "UNKNOWN": 1, "GREEN": 0}
    assert any(
        step.startswith("w: ") and "boresight repair" in step for step in summary["next_steps"]
    )  # days do not bring them back


def test_a_service_ends_what_is_kept_and_a_repair_of_the_lake_ends_the_keeping(files, capsys):
    audited(files, capsys)
    lose(files[1], "v")
    assert audited(files, capsys)[1]["statuses"]["RED"] == 1
    assert service(lake=str(files[1]), vehicle="v", day="2026-03-15", kind="repair", sensor="radar") == 0
    assert audited(files, capsys)[1]["statuses"]["RED"] == 0
    assert repair_table(Lake.at(files[1]), CALIBRATIONS).lost
    code, summary = audited(files, capsys)
    assert (code, summary["damaged"]) == (0, [])


def test_a_damaged_log_changes_no_verdict_and_a_night_stops_before_it_begins(files, capsys):
    _, whole = audited(files, capsys)
    log = sorted((files[1] / "calibrations" / "_delta_log").glob("*.json"))
    log[-1].write_bytes(b"")
    code, summary = audited(files, capsys)
    assert (code, summary["statuses"]) == (3, whole["statuses"])
    assert "boresight repair --lake" in summary["damaged"][0]
    with pytest.raises(DamagedLogError, match="boresight repair"):
        Ledger(Lake.at(files[1]), [])

"""The lake that Boresight 1.0 wrote: every later release reads it.

Where a test here fails, a schema changed. Put the column back; or give the table its next version, and let its
readers take the version before as well. Nobody makes this lake again: it stands for those that users have.
tests/makers/frozen_lake.py made it by the commands of 1.0.0; digests.json has what readers found in it then.
"""

import json
import shutil
from pathlib import Path
from typing import get_args

import pytest

from jobs.cli import main
from jobs.show import Table
from pipeline.store.partitions import Lake
from tests.makers.frozen_lake import DIGESTS, digests

KEPT = Path(__file__).parent / "lake_1_0"


@pytest.fixture
def lake(tmp_path):
    return shutil.copytree(KEPT, tmp_path / "lake")


def test_every_column_of_every_table_is_read_as_1_0_read_it(lake):
    then, now = json.loads((lake / DIGESTS).read_text()), digests(Lake.at(lake))
    columns = {(table, name): digest for table, of in then.items() for name, digest in of.items()}
    assert len(then) == 16
    assert not [table for table, of in then.items() if "no rows" in of.values()]
    assert {c: now.get(c[0], {}).get(c[1], "no such column") for c in columns} == columns


def test_every_table_that_show_has_is_shown(lake, capsys):
    for table in get_args(Table):
        assert main(["show", table, "--lake", str(lake), "--json"]) == 0
        assert json.loads(capsys.readouterr().out), table


def test_its_states_are_shown_exported_and_audited_again(lake, tmp_path, capsys):
    place = ["--lake", str(lake), "--vehicle", "vehicle-1"]
    assert main(["state", *place]) == 0
    assert "signed off by anna" in " ".join(capsys.readouterr().out.split())
    assert main(["export", "ros2", *place, "--signed-off", "--out", str(tmp_path / "launch")]) in (0, 3)
    assert main(["status", *place]) == 0
    assert "repair of radar on 2026-03-03 is not audited yet" in capsys.readouterr().out
    assert main(["audit", "--fleet", str(lake / "fleet.toml"), "--lake", str(lake)]) in (0, 3)
    assert main(["status", *place]) == 0
    assert "is not audited yet" not in capsys.readouterr().out

"""A disk that is really full, a small one mounted for the test: what could not be written is named with its path."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zstandard

from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from tests.audit.fleet_records import vehicle_records
from tests.jobs.test_exit_codes import DAY, night, rig_of

IN_ITS_OWN = ("unshare", "--user", "--map-root-user", "--mount")  # mounts of its own; needs no root
# With the disk mounted: do FIRST, fill what it leaves but for SPARE kilobytes, and run the command.
SCRIPT = """mount -t tmpfs -o size=64m tmpfs "$DISK" && sh -c "$FIRST" || exit 9
mount -o remount,size=$(( $(du -sk "$DISK" | cut -f1) + SPARE ))k "$DISK" || exit 9
exec "$@" """
COMMAND = "import sys; from jobs.cli import main; sys.exit(main())"


@pytest.fixture
def on_full_disk(tmp_path):
    """Run a command that fails for want of space; returns the summary. `.disk` has `spare` kilobytes left."""
    disk = tmp_path / "disk"
    disk.mkdir()
    tried = [*IN_ITS_OWN, "true"] if shutil.which("unshare") else ["false"]
    if subprocess.run(tried, capture_output=True, check=False).returncode:
        pytest.skip("no namespace can be made here, so no small disk be mounted")

    def run(spare, *command, first="true", **env):
        about = {"DISK": disk, "FIRST": first, "SPARE": spare, **env}
        shell = ["env", *(f"{k}={v}" for k, v in about.items()), "sh", "-c", SCRIPT, "sh"]
        call = [*IN_ITS_OWN, *shell, sys.executable, "-c", COMMAND, *map(str, command)]
        done = subprocess.run(call, capture_output=True, text=True, check=False)
        assert done.returncode == 1, done.stderr
        return json.loads(done.stdout.splitlines()[-1])

    run.disk = disk
    return run


@pytest.mark.parametrize(
    ("spare", "table"), [(40, "sweeps"), pytest.param(200, "features", marks=pytest.mark.slow)]
)
def test_a_partition_without_space_is_named(spare, table, on_full_disk, tmp_path):
    lake = on_full_disk.disk / "lake"
    [problem] = on_full_disk(spare, *night(rig_of(tmp_path, car="default"), lake))["problems"]
    assert problem["status"] == "failed"
    for named in ("No space left", f"{lake}/", f"{table}/vehicle=car/day={DAY}"):
        assert named in problem["reason"]


def test_a_record_table_without_space_is_named(on_full_disk, tmp_path):
    records = vehicle_records("v", 3, np.random.default_rng(1))
    commit_records(Lake.at(tmp_path / "lake"), CALIBRATIONS, records)
    lake = on_full_disk.disk / "lake"
    event = ["--vehicle", "v", "--day", "2026-03-02", "--kind", "repair"]
    copied = f"cp -r {tmp_path}/lake {on_full_disk.disk}"
    summary = on_full_disk(0, "service", "--lake", lake, *event, first=copied)
    assert "No space left" in summary["reason"]
    assert f"{lake}/service_events" in summary["reason"]


def test_a_temporary_folder_without_space_is_named_and_the_log_not_called_damaged(on_full_disk, tmp_path):
    rig_of(tmp_path, car="default")
    log = tmp_path / "logs" / "car" / DAY / "a.mcap"
    Path(f"{log}.zstd").write_bytes(zstandard.compress(log.read_bytes()))
    log.unlink()
    summary = on_full_disk(16, *night(tmp_path), TMPDIR=on_full_disk.disk)
    [problem] = summary["problems"]
    assert problem["status"] == "failed"  # another night tries it again
    assert f"{on_full_disk.disk}/boresight-unpacked" in problem["reason"]
    assert "no space left" in problem["reason"]


@pytest.mark.parametrize(
    ("command", "option"),
    [
        (["simulate", "--vehicles", 1, "--days", 1, "--frames", 3], "--out={}"),
        (["export", "schemas"], "--out {}"),
    ],
)
def test_an_output_without_space_is_named(command, option, on_full_disk):
    out = on_full_disk.disk / "out"
    summary = on_full_disk(8, *command, *option.format(out).split())
    assert "No space left" in summary["reason"]
    assert str(out) in summary["reason"]

"""Every exit code of the table in pipeline/fleet/README.md, by real commands on real logs."""

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from tests.audit.fleet_records import vehicle_records
from tests.makers.commands import command
from tests.makers.fleet_files import fleet_toml
from tests.makers.processes import started
from tests.makers.written_logs import Kit

DAY = "2023-11-14"  # of the written logs
README = Path(__file__).parents[2] / "pipeline" / "fleet" / "README.md"
MISTYPED = """
[rigs.mistyped.camera]
image = "/camera/imag"
info = "/camera/inf"
semantics = { source = "topics", labels = "/perception/labels", detections = "/perception/detections" }
[rigs.mistyped.lidar]
points = "/lidar/point"
[rigs.mistyped.radar]
points = "/radar/point"
"""

# A command of a shell's background, as tests may be, ignores SIGINT from birth.
LISTENING = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from jobs.cli import main
sys.exit(main())
"""


def table() -> dict[int, str]:
    """Exit codes that the README lists, each with the summary's status."""
    rows = re.findall(r"^\| (\d+) \| ([a-z, ]+) \|", README.read_text(), re.MULTILINE)
    return {int(code): status for code, status in rows}


def rig_of(folder: Path, **rigs: str) -> Path:
    """A fleet.toml whose vehicles are on these rigs, and a short drive of each."""
    for vehicle in rigs:
        log = folder / "logs" / vehicle / DAY
        log.mkdir(parents=True)
        Kit(frames=4).drive().mcap(log / "a.mcap")
    named = "".join(f'[vehicles."{v}"]\nrig = "{rig}"\n' for v, rig in rigs.items())
    (folder / "fleet.toml").write_text(fleet_toml() + MISTYPED + named)
    return folder


def night(folder: Path, lake: Path | None = None) -> list[str]:
    logs = f"{folder}/logs/{{vehicle}}/{{day}}/*"
    options = [
        "--lake", f"{lake or folder / 'lake'}", "--logs", logs, "--executor", "inline", "--no-pictures",
    ]  # fmt: skip
    return ["nightly", "--fleet", f"{folder}/fleet.toml", *options]


def nothing_new(folder: Path) -> list[str]:
    return ["export", "schemas", "--out", f"{folder}/schemas"]


def full_disk(folder: Path) -> list[str]:
    asked = night(rig_of(folder, car="default"))
    (folder / "lake").mkdir()
    (folder / "lake" / "moments").touch()  # no folder can be made here
    return asked


def nothing_certified(folder: Path) -> list[str]:
    lake, rng = Lake.at(folder / "lake"), np.random.default_rng(1)
    commit_records(lake, CALIBRATIONS, vehicle_records("car", 1, rng, status=lambda _day: "refused"))
    day = ["--vehicle", "car", "--day", "2026-03-01"]
    return ["export", "ros2", "--lake", f"{folder}/lake", *day, "--out", f"{folder}/out"]


def no_day_yet(folder: Path) -> list[str]:
    (folder / "logs" / "car" / "2999-03-02").mkdir(parents=True)
    (folder / "logs" / "car" / "2999-03-02" / "a.mcap").touch()
    (folder / "fleet.toml").write_text(fleet_toml("car"))
    return night(folder)


def short_log(folder: Path) -> list[str]:
    rig_of(folder, car="default")
    log = f"{folder}/logs/car/{DAY}/a.mcap"
    return ["verify", log, "--fleet", f"{folder}/fleet.toml", "--vehicle", "car"]


CODES = {0: nothing_new, 1: full_disk, 3: no_day_yet, 4: nothing_certified, 5: short_log}


@pytest.mark.parametrize(("code", "asked"), CODES.items())
def test_each_code_of_the_table_is_what_a_command_returns_with_the_status_it_lists(
    code, asked, tmp_path, capsys
):
    told = command(capsys, *asked(tmp_path))
    assert told.code == code
    assert told.summary["status"] in table()[code].split(", ")


@pytest.mark.parametrize("code", [130, 143])
def test_a_stopped_command_ends_with_the_code_of_its_signal(code, tmp_path):
    options = ["--out", str(tmp_path / "fleet"), "--vehicles", "1", "--days", "9", "--frames", "300"]
    call = [sys.executable, "-c", LISTENING, "simulate", *options]
    with started(call, stdout=subprocess.PIPE, text=True) as process:
        while not list(tmp_path.rglob("logs/*/*")):
            assert process.poll() is None
            time.sleep(0.1)
        process.send_signal(signal.Signals(code - 128))
        out, _ = process.communicate(timeout=1800)
    assert process.returncode == code
    assert set(table()) == {*CODES, 2, 130, 143}  # each is tried here
    assert json.loads(out.splitlines()[-1])["status"] in table()[code].split(", ")


def test_a_rig_whose_days_are_all_misconfigured_is_named_and_the_others_go_on(tmp_path, capsys):
    code, summary, *_ = command(capsys, *night(rig_of(tmp_path, car="default", van="mistyped")))
    assert code == 2
    assert summary["status"] in table()[2].split(", ")
    assert set(summary["misconfigured"]) == {"mistyped"}
    assert "/camera/imag" in summary["misconfigured"]["mistyped"]
    why = {p["vehicle"]: p["reason"] for p in summary["problems"]}
    assert "in fleet.toml" in why["van"]
    assert "in fleet.toml" not in why["car"]
    # One day of several without its topic says nothing of fleet.toml.
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(fleet.read_text().replace('rig = "mistyped"', 'rig = "default"'))
    Kit(frames=4).drive().without("/lidar/points").mcap(tmp_path / "logs" / "van" / DAY / "a.mcap")
    code, summary, *_ = command(capsys, *night(tmp_path))
    assert (code, summary["status"], summary["refused"]) == (3, "refused", 2)


def test_a_refused_day_is_a_success_where_the_scheduler_knows_no_other(tmp_path, capsys):
    asked = no_day_yet(tmp_path)
    code, summary, *_ = command(capsys, *asked, "--held-exit-code", "0")
    assert (code, summary["status"], summary["refused"]) == (0, "refused", 1)
    assert command(capsys, *asked, "--held-exit-code", "1").code == 2  # no other can be asked for


def test_a_night_is_told_to_monitoring_and_metrics_that_cannot_be_written_fail_nothing(tmp_path, capsys):
    pytest.importorskip("prometheus_client", reason="pip install 'boresight[ops]'")
    asked = no_day_yet(tmp_path)
    assert command(capsys, *asked, "--metrics", f"{tmp_path}/night.prom").code == 3
    metrics = (tmp_path / "night.prom").read_text()
    assert 'boresight_vehicle_days{fleet="tests",status="refused"} 1.0' in metrics
    assert "boresight_last_success_timestamp_seconds" in metrics
    told = command(capsys, *asked, "--metrics", f"{tmp_path}/missing/night.prom")
    assert (told.code, told.summary["status"]) == (3, "refused")
    assert f"{tmp_path}/missing/night.prom" in told.err

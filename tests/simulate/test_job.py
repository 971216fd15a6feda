"""The command: its summary, what it refuses, and its end in the middle."""

import json
import signal
import subprocess
import sys
import time

import psutil
import pytest

import pipeline.simulate.reflectors
from jobs.simulate import simulate
from pipeline.core.errors import ConfigError
from tests.makers.processes import started


def test_the_job_ends_with_one_line_of_json_that_says_where_things_are(tmp_path, capsys, monkeypatch):
    full = pipeline.simulate.reflectors.simulate_reflectors
    few = lambda *where, **how: full(*where, frames=2, **how)  # noqa: E731
    monkeypatch.setattr(pipeline.simulate.reflectors, "simulate_reflectors", few)
    knocked = {"faults": "vehicle-1:0:radar:yaw:1.2", "container": "mixed", "reflectors": True}
    assert simulate(out=tmp_path, vehicles=1, days=1, frames=3, **knocked) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (summary["command"], summary["status"]) == ("simulate", "done")
    assert (summary["frames"], summary["logs"], len(summary["reflectors"])) == (3, 3, 1)
    assert [p.name for p in (tmp_path / "truth" / "vehicle-1").iterdir()] == ["2026-03-02.json"]
    kinds = {p.suffix for p in (tmp_path / "logs" / "vehicle-1" / "2026-03-02").iterdir()}
    assert kinds == {".mcap", ".bag", ""}
    assert json.loads((tmp_path / "reflectors/vehicle-1/2026-03-02.json").read_text())["frames"] == 2


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"first_day": "yesterday"}, "yesterday"), ({"faults": "x"}, "faults"), ({"frames": 0}, "frames"),
        ({"vehicles": 0}, "vehicles"), ({"rate_hz": -1.0}, "rate_hz"), ({"rig": "van", "reflectors": True}, "van"),
        *(({"rig": rig}, "corner-left") for rig in ("corner-middle", "random-", "random-x")),
        ({"rig": "rows-32"}, "rows-ROWS-DEGREES"),
        *(({"environments": world}, "world-SEED") for world in ("world-", "world-x", "moon", "random-1")),
    ],
)  # fmt: skip
def test_the_job_refuses_what_cannot_be_before_it_writes_anything(wrong, named, tmp_path):
    with pytest.raises(ConfigError, match=named):
        simulate(out=tmp_path / "out", **wrong)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_simulation_in_several_processes_stops_at_once_and_leaves_no_half_log(tmp_path):
    command = [f"{sys.prefix}/bin/boresight", "simulate", "--out", tmp_path, "--vehicles", "2", "--days", "2"]
    command += ["--frames", "90", "--workers", "2"]
    quiet = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with started(list(map(str, command)), **quiet) as running:
        _wait_until(lambda: len(list(tmp_path.glob("logs/*/*/.partial-*"))) == 2, 1800)
        workers = [p for p in psutil.Process(running.pid).children() if "spawn_main" in " ".join(p.cmdline())]
        workers[0].kill()  # as a machine without memory does: it cleans nothing up
        running.send_signal(signal.SIGTERM)
        stdout, _ = running.communicate(timeout=1800)
    assert running.returncode == 128 + signal.SIGTERM
    assert json.loads(stdout.splitlines()[-1])["status"] == "stopped"
    assert not [p for p in tmp_path.glob("logs/*/*/*") if p.name.startswith(".partial") or p.is_file()]


def _wait_until(true, seconds):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.1)

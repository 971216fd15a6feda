import json
import signal
import subprocess
import sys
import time

import pytest

from jobs import cli
from pipeline.core.errors import ConfigError, LogError, SolveError
from tests.makers.fleet_files import fleet_toml
from tests.makers.processes import started


@pytest.fixture(autouse=True)
def _signals():
    """Give SIGTERM back to who had it."""
    handler = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, handler)


@pytest.fixture
def command(monkeypatch):
    """Make `boresight audit` do what a test wants."""

    def behave(error):
        def audit() -> int:
            raise error

        import jobs.audit

        monkeypatch.setattr(jobs.audit, "audit", audit)
        app = cli.App(name="boresight", result_action="return_value", suppress_keyboard_interrupt=False)
        app.command("jobs.audit:audit", name="audit")
        monkeypatch.setattr(cli, "app", app)

    return behave


@pytest.mark.parametrize(
    ("what", "code", "status", "reason"),
    [
        (ConfigError("fleet.toml", "rigs", "unknown key"), 2, "failed", "fleet.toml: rigs: unknown key"),
        (LogError("a.mcap", "is empty"), 1, "failed", "a.mcap: is empty"),
        (SolveError("a straight drive"), 3, "refused", "a straight drive"),
        (KeyboardInterrupt(), 130, "stopped", "interrupted"),
        (SystemExit(143), 143, "stopped", "terminated"),
        (ZeroDivisionError("x"), 1, "failed", "ZeroDivisionError: x"),
    ],
)
def test_every_end_has_its_exit_code_a_line_for_people_and_a_summary(
    what, code, status, reason, command, capsys
):
    command(what)
    assert cli.main(["audit"]) == code
    captured = capsys.readouterr()
    summary = {"command": "audit", "status": status, "reason": reason, "exit_code": code}
    assert json.loads(captured.out.splitlines()[-1]) == summary
    lines = [json.loads(line) for line in captured.err.splitlines()]
    assert lines[-1]["event"] == reason
    # The traceback of a surprise is in the log, of an expected error it is not.
    has_trace = any("Traceback" in line.get("exception", "") for line in lines)
    assert has_trace == isinstance(what, ZeroDivisionError)


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["audit"],
        ["audit", "--fleet", "x.toml", "--lake", "l", "--colour", "red"],
        ["nightly", "--fleet", "x", "--lake", "l", "--logs", "p", "--executor", "magic"],
        ["nightly", "--fleet", "x", "--lake", "l", "--logs", "p", "--workers", "many"],
        ["audit", "--fleet", "nowhere.toml", "--lake", "l"],
        ["show", "nonsense", "--lake", "l"],
    ],
)
def test_wrong_usage_exits_with_2_and_says_why(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 2
    assert json.loads(capsys.readouterr().err.splitlines()[-1])["event"]
    assert list(tmp_path.iterdir()) == []


def test_the_help_of_a_command_is_the_whole_text_of_its_function(capsys):
    assert cli.main(["export", "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "boresight export frames --help" in shown
    assert "Exit codes: 0 all that the vehicle has is current" in shown


READERS = {
    "audit": [],
    "report": ["--out", "x.html"],
    "perceive": ["--vehicle", "v", "--day", "2026-03-02"],
    "prepare": [],
    "service": ["--vehicle", "v", "--day", "2026-03-02", "--kind", "repair"],
    "show": ["calibrations"],
    "state": [],
    "status": [],
    "gc": ["--images-days", "30"],
}


@pytest.mark.parametrize("command_name", READERS)
def test_a_mistyped_lake_is_wrong_usage_and_no_empty_lake(command_name, tmp_path, capsys):
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(fleet_toml("v"))
    with_fleet = command_name in ("audit", "report", "perceive", "prepare")
    arguments = [command_name, *READERS[command_name], "--lake", str(tmp_path / "lkae")]
    assert cli.main([*arguments, *(["--fleet", str(fleet)] if with_fleet else [])]) == 2
    assert "lkae" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["fleet.toml"]


def test_the_installed_command_exports_schemas(tmp_path):
    script = f"{sys.prefix}/bin/boresight"
    done = subprocess.run(
        [script, "export", "schemas", "--out", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0
    outputs = json.loads(done.stdout.splitlines()[-1])["outputs"]
    assert len(outputs) == len(list(tmp_path.glob("*.schema.json"))) > 3


SLEEPER = """
import sys, time
import jobs.export
from pathlib import Path
from jobs import cli

def export(what: str, *, out: Path) -> int:
    from pipeline.store.atomic_write import atomic_write
    with atomic_write(out / "x.parquet") as stream:
        stream.write(b"half")
        stream.flush()
        (out / "begun").touch()
        time.sleep(60)
    return 0

jobs.export.export = export
sys.exit(cli.main(["export", "schemas", "--out", sys.argv[1]]))
"""


def test_sigterm_ends_a_command_with_143_and_nothing_half_written(tmp_path):
    command = [sys.executable, "-c", SLEEPER, str(tmp_path)]
    with started(command, stdout=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 1800
        while not (tmp_path / "begun").exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=1800)
    assert process.returncode == 143
    assert json.loads(out.splitlines()[-1])["status"] == "stopped"
    assert [p.name for p in tmp_path.iterdir()] == ["begun"]

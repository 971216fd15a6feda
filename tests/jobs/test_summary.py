import json
import time
from pathlib import Path

import numpy as np
import pytest

from jobs.terminal.summary import exit_code, print_json, print_summary, progress_reporter


def test_the_summary_is_one_strict_json_line(capsys):
    print_summary(
        "x", "done", a=np.float64("nan"), b=np.arange(2), c=Path("p"), d={1: (np.int64(2), float("inf"))}
    )
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    told = {"command": "x", "status": "done", "a": None, "b": [0, 1], "c": "p", "d": {"1": [2, None]}}
    assert json.loads(out) == told
    with pytest.raises(TypeError, match="object"):
        print_json(object())


@pytest.mark.parametrize(
    ("statuses", "code"),
    [
        ("", 0), ("done cached accepted", 0), ("done held", 3), ("done partly", 3), ("refused", 3),
        ("held misconfigured", 2), ("held failed misconfigured done", 1),
    ],
)  # fmt: skip
def test_the_worst_status_decides_the_exit_code(statuses, code):
    assert exit_code(statuses.split()) == code


def test_without_a_terminal_a_json_line_comes_every_few_seconds_even_where_a_step_takes_longer(
    capsys, monkeypatch
):
    monkeypatch.setattr("jobs.terminal.summary.LOG_EVERY_S", 0.05)
    text, deadline = "", time.monotonic() + 1800
    with progress_reporter("ingest") as progress:
        progress(3, 12, "frame")
        while text.count("\n") < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
            text += capsys.readouterr().err
    found = {
        tuple(json.loads(line)[k] for k in ("job", "done", "total", "what")) for line in text.splitlines()
    }
    assert found == {("ingest", 3, 12, "frame")}
    capsys.readouterr()
    time.sleep(0.15)
    assert capsys.readouterr().err == ""  # nothing after the end
    monkeypatch.undo()
    with progress_reporter("ingest") as progress:
        progress(3, 12, "frame")
    assert capsys.readouterr().err == ""  # shorter than the time between lines

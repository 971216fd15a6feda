import json
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
    assert json.loads(out) == {
        "command": "x",
        "status": "done",
        "a": None,
        "b": [0, 1],
        "c": "p",
        "d": {"1": [2, None]},
    }


def test_values_that_json_cannot_carry_are_an_error():
    with pytest.raises(TypeError, match="object"):
        print_json(object())


@pytest.mark.parametrize(
    ("statuses", "code"),
    [
        ([], 0),
        (["done", "cached", "accepted"], 0),
        (["done", "held"], 3),
        (["done", "partly"], 3),
        (["refused"], 3),
        (["held", "failed", "done"], 1),
    ],
)
def test_the_worst_status_decides_the_exit_code(statuses, code):
    assert exit_code(statuses) == code


def test_progress_without_a_terminal_is_a_json_line_now_and_then(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    with progress_reporter("ingest") as progress:
        for second in range(12):
            now[0] = float(second)
            progress(second, 12, "frame")
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [line["done"] for line in lines] == [5, 10]
    assert lines[0]["job"] == "ingest"

"""Speeds as ratios against a committed baseline: a table at the end, a failure where one is clearly worse.

    make bench           compares with baseline.json
    make bench-accept    writes what was measured into it: the only way that its values change

What is measured goes to results/speed.json as well (times and sizes too, which no baseline holds): the lines that
documents quote; `make bench-accept` alone writes it.

A ratio's `noise` says what the same code scatters by on a shared machine; worse than the baseline by more is a
regression. `goal` is what it ought to be, and only printed: an unmet goal is not hidden, and does not turn red.
"""

import json
import subprocess
import time
from pathlib import Path

import pytest

BASELINE = Path(__file__).parent / "baseline.json"
SPEED = Path(__file__).parent / "results" / "speed.json"
_PLAIN = pytest.StashKey[dict[str, dict[str, object]]]()
_MEASURED = pytest.StashKey[dict[str, float]]()


def pytest_addoption(parser):
    parser.addoption(
        "--accept-baseline", action="store_true", help="write what is measured into baseline.json"
    )


def pytest_configure(config):
    config.stash[_MEASURED] = {}
    config.stash[_PLAIN] = {}


@pytest.fixture
def gate(request):
    """Compare one measured ratio or count with its baseline."""
    known = json.loads(BASELINE.read_text())["metrics"]

    def compare(name, value):
        assert name in known, f"{name} has no line in {BASELINE.name}"
        request.config.stash[_MEASURED][name] = float(value)
        if request.config.getoption("--accept-baseline"):
            return
        worse = _worse_by(known[name], value)
        assert worse <= known[name]["noise"], (
            f"{name}: {value:.3g}, baseline {known[name]['value']:.3g}: worse by {worse:.0%}"
        )

    return compare


@pytest.fixture
def record(request):
    """Keep a measured time, size or ratio for results/speed.json; nothing is compared."""

    def keep(name, value, what, goal=None):
        request.config.stash[_PLAIN][name] = {"value": float(f"{value:.3g}"), "what": what, "goal": goal}

    return keep


def pytest_terminal_summary(terminalreporter, config):
    measured, plain = config.stash[_MEASURED], config.stash[_PLAIN]
    content = json.loads(BASELINE.read_text())
    if config.getoption("--accept-baseline"):
        _write_speed(content["machine"], content["metrics"], measured, plain)
    if not measured:
        return
    terminalreporter.section("measured against the baseline")
    for line in _table(content, measured):
        terminalreporter.write_line(line)
    if config.getoption("--accept-baseline"):
        for name, value in measured.items():
            content["metrics"][name]["value"] = round(value, 3)
        content |= {"date": time.strftime("%Y-%m-%d"), "commit": _commit()}
        BASELINE.write_text(json.dumps(content, indent=1) + "\n")
        terminalreporter.write_line(f"accepted into {BASELINE}")


def _write_speed(machine, metrics, measured, plain):
    """Lines of this run over those of earlier ones: one file of benchmarks may be run alone."""
    lines = json.loads(SPEED.read_text())["lines"] if SPEED.exists() else {}
    about = {"commit": _commit(), "date": time.strftime("%Y-%m-%d")}
    gated = {
        name: {
            "value": float(f"{value:.3g}"),
            "what": metrics[name]["what"],
            "goal": metrics[name].get("goal"),
        }
        for name, value in measured.items()
    }
    lines |= {name: line | about for name, line in (gated | plain).items()}
    SPEED.write_text(json.dumps({"machine": machine, "lines": lines}, indent=1) + "\n")


def _worse_by(known, value):
    """By which share of the baseline it is worse; negative = better."""
    ratio = known["value"] / value if known["better"] == "higher" else value / known["value"]
    return ratio - 1


def _table(content, measured):
    yield f"{'':32s} {'now':>8s} {'baseline':>9s} {'noise':>6s} {'goal':>8s}   {content['commit']}, {content['date']}"
    for name, value in measured.items():
        known = content["metrics"][name]
        better = known["better"] == "higher"
        goal = known.get("goal")
        met = goal is None or (value >= goal if better else value <= goal)
        verdict = "" if met else "goal unmet"
        if _worse_by(known, value) > known["noise"]:
            verdict = "WORSE than the baseline"
        sign = ">=" if better else "<="
        wanted = "-" if goal is None else f"{sign} {goal:g}"
        yield (
            f"{name:32s} {value:8.3g} {known['value']:9.3g} {known['noise']:6.0%} {wanted:>8s}   {verdict}"
            f"{'  ' if verdict else ''}{known['what']}"
        )


def _commit():
    run = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        check=False,
        cwd=BASELINE.parent,
    )
    return run.stdout.strip() or "unknown"

import json
import time

from jobs.terminal.night_view import night_view
from pipeline.fleet.nightly import DayOutcome

NAMES = ["car 2026-03-02", "car 2026-03-03", "bus 2026-03-02"]
OUTCOMES = [
    DayOutcome("car", "2026-03-02", "done", pairs={"camera_lidar": "accepted", "lidar_radar": "accepted"}),
    DayOutcome("car", "2026-03-03", "failed", "OSError: disk full", trace="Traceback ..."),
    DayOutcome("tram", "2026-03-02", "refused", "no such vehicle"),
]


def show(names=NAMES):
    with night_view(names, 4) as view:
        view.watch(0, 3, 10, "ingest frames")
        view.watch(1, 0, 0, "perceive")
        for outcome in OUTCOMES:
            view.finished(outcome)
        view.ended("bus 2026-03-02")


def lines_of(capsys):
    return [json.loads(line) for line in capsys.readouterr().err.splitlines()]


def test_without_a_terminal_every_vehicle_day_that_ends_is_one_json_line(capsys):
    show()
    lines = [line for line in lines_of(capsys) if line["event"] != "stage"]
    assert [(line["level"], line.get("status")) for line in lines] == [
        ("info", "done"), ("error", "failed"), ("info", "refused"), ("info", None),
    ]  # fmt: skip
    assert lines[1]["trace"].startswith("Traceback")
    assert (lines[2]["ended"], lines[2]["total"]) == (3, 4)


def test_without_a_terminal_every_stage_that_begins_is_one_json_line(capsys):
    with night_view(NAMES, 3) as view:
        for done in range(3):
            view.watch(0, done, 3, "ingest frames")
        view.watch(2, 0, 0, "ingest frames")
        view.watch(0, 1, 9, "perceive frames")
        view.watch(1, 1, 9, NAMES[1])  # what is simulated is no stage
    told = [(line["vehicle"], line["day"], line["stage"]) for line in lines_of(capsys)]
    car, bus = ("car", "2026-03-02"), ("bus", "2026-03-02")
    assert told == [(*car, "ingest"), (*bus, "ingest"), (*car, "perceive")]


def test_without_a_terminal_a_stage_that_takes_long_has_a_line_every_few_seconds(capsys, monkeypatch):
    monkeypatch.setattr("jobs.terminal.night_view.LOG_EVERY_S", 0.05)
    with night_view(NAMES, 3) as view:
        view.watch(0, 0, 9, "perceive frames")
        view.watch(0, 1, 9, "perceive frames")  # at once: no line
        time.sleep(0.06)
        view.watch(0, 2, 9, "perceive frames")
    told = [
        (line["event"], line["vehicle"], line.get("done"), line.get("total")) for line in lines_of(capsys)
    ]
    assert told == [("stage", "car", None, None), ("progress", "car", 2, 9)]


def test_on_a_terminal_every_end_is_a_line_and_bars_do_not_stay(capsys, monkeypatch):
    monkeypatch.setattr("jobs.terminal.night_view.is_terminal", lambda: True)
    show()
    text = capsys.readouterr().err
    assert "2/2 pairs accepted" in text
    assert "disk full" in text
    assert "refused" in text
    assert "ingest frames" not in text.splitlines()[-1]

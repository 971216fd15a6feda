"""The table of words in pipeline/fleet/README.md, walked through on one lake: each place that names a state."""

import re
from dataclasses import replace
from itertools import chain, combinations_with_replacement
from pathlib import Path

import numpy as np
import pytest

from jobs.terminal.night_view import _MARKS
from jobs.terminal.record_tables import STATUS_STYLES
from pipeline.core.results import Outcome
from pipeline.fleet.ledger import Ledger
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS, PAIRS
from schemas.calibrations import STATUSES as RECORD_WORDS
from schemas.drift import DRIFT_STATUSES
from schemas.outcomes import OUTCOME_STATUSES
from schemas.states import STATES
from schemas.words import DAY_WORDS, day_word
from tests.audit.fleet_records import vehicle_records
from tests.makers.commands import command
from tests.makers.fleet_pages import write_fleet_page
from tests.makers.stages import audit_fleet
from tests.report.test_pages import _config

README = Path(__file__).parents[2] / "pipeline" / "fleet" / "README.md"
# The one word for a day, and its pairs' statuses.
DAYS = {
    "done": ("accepted", "accepted", "accepted"),
    "partly": ("accepted", "held", "accepted"),
    "held": ("held", "held", "refused"),
    "refused": ("refused", "refused", "refused"),
}


def table() -> dict[str, list[str]]:
    """The README's words by what they are of, without what stands in brackets."""
    rows = re.findall(r"^\| ((?:a|an|the) [^|]+) \| ([^|]+) \|", README.read_text(), re.MULTILINE)
    return {what: re.sub(r" \([^)]*\)", "", words).split(", ") for what, words in rows}


def test_the_table_lists_the_words_that_the_code_has():
    listed = table()
    assert listed["a record (pair and day)"] == list(RECORD_WORDS)
    assert sorted(listed["a vehicle-day"]) == sorted(DAY_WORDS)
    assert set(listed["an exported calibration"]) == set(DAYS)
    assert listed["a stage of a vehicle-day"] == list(OUTCOME_STATUSES)
    assert set(listed["a vehicle"]) == set(DRIFT_STATUSES)
    assert all(word in STATES.column("status").doc for word in listed["the state of a sensor or a pair"])
    assert listed["a training run"] == ["done", "time_limit", "stopped"]
    assert len(listed) == 7
    assert {*DAY_WORDS, "cached"} - {"missing"} == set(_MARKS)
    assert set(RECORD_WORDS) | set(DRIFT_STATUSES) <= set(STATUS_STYLES)


def test_every_day_has_one_word_and_an_accepted_pair_is_never_hidden():
    for pairs in chain.from_iterable(combinations_with_replacement(RECORD_WORDS, n) for n in (1, 2, 3)):
        word = day_word(pairs)
        assert word in DAYS
        assert (word in ("done", "partly")) == ("accepted" in pairs)
        assert (word == "done") == (set(pairs) == {"accepted"})


@pytest.fixture(scope="module")
def lake(tmp_path_factory) -> tuple[Lake, dict[str, str]]:
    """A lake with a day of each word, and which day has which."""
    lake = Lake.at(tmp_path_factory.mktemp("words") / "lake")
    found = vehicle_records("v", len(DAYS), np.random.default_rng(5))
    days = dict(zip(sorted({r.day for r in found}), DAYS, strict=True))
    records = []
    for r in found:
        status = DAYS[days[r.day]][PAIRS.index(r.pair)]
        gone = {"qw": None, "covariance": None} if status == "refused" else {}
        records.append(replace(r, status=status, determined=["azimuth", "elevation"], **gone))
    commit_records(lake, CALIBRATIONS, records)
    ledger = Ledger(lake, [Partition("v", day) for day in days])
    for day, word in days.items():
        kept = {status: DAYS[word].count(status) for status in RECORD_WORDS}
        stage_word = "refused" if word == "refused" else "done"
        ledger.add(Outcome("calibrate", "v", day, stage_word, f"key {day}", kept=kept), "joint")
    ledger.commit()
    audit_fleet(lake, _config())
    return lake, days


def test_status_page_and_export_call_each_day_by_the_same_word(lake, tmp_path, capsys):
    lake, days = lake
    told = command(capsys, "status", "--lake", lake.root, "--json").summary
    assert {d["day"]: d["status"] for d in told["days"]} == days
    assert [told[word] for word in DAYS] == [1, 1, 1, 1]
    page = write_fleet_page(lake, _config(), tmp_path / "fleet.html")
    chips = dict(re.findall(r'class="c \w+"[^>]* title="(\d{4}-\d\d-\d\d): (\w+)', page))
    assert chips == days
    of_v = ["--lake", lake.root, "--vehicle", "v", "--out", tmp_path / "out"]
    exported = {d: command(capsys, "export", "ros2", *of_v, "--day", d).summary["status"] for d in days}
    assert exported == days

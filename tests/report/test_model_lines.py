"""The fleet page and the night's summary on model lines: what is shared, who differs, and who has too few vehicles."""

import re

import numpy as np
import pytest

from jobs.terminal.vehicle_status import model_lines
from pipeline.config import FleetConfig
from pipeline.report.stage import Pages, write_day_page, write_fleet_report
from pipeline.stage_work import Task, Window
from pipeline.stages import AUDIT, LINES
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS
from tests.makers.fleet_lakes import one_rig_fleet
from tests.makers.line_records import DEG, MadeLine, line_records

LAST = "2026-03-03"
VEHICLES = {"car-*": {"rig": "default"}, "van-*": {"rig": "default", "model": "van"}}


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Page in words and summary of a line of 30, one of them unlike it, and of a line of four."""
    folder = tmp_path_factory.mktemp("lines")
    knock, bias = np.array([0, 0, 1.5 * DEG, 0, 0, 0]), np.array([0, 0.8 * DEG, 0, 0, 0, 0])
    line = MadeLine(
        30,
        3,
        seed=4,
        bias={"lidar_radar": bias},
        motion=lambda v, _: {"lidar_radar": knock} if v == 7 else {},
    )
    lake = Lake.at(folder / "lake")
    commit_records(
        lake, CALIBRATIONS, [*line_records(line), *line_records(MadeLine(4, 3, seed=5, name="van"))]
    )
    fleet = FleetConfig.model_validate(
        one_rig_fleet().model_dump(exclude_defaults=True) | {"vehicles": VEHICLES}
    )
    task = Task(fleet, lake, Window())
    AUDIT.run(task)
    told = model_lines([LINES.run(task)])
    page = folder / "fleet.html"
    write_fleet_report(lake, fleet, Pages(page), "joint")
    words = words_of(page)
    day = words_of(write_day_page(lake, Partition("car-0003", LAST), fleet, folder / "day.html", "joint"))
    before = write_day_page(lake, Partition("car-0003", "2026-03-02"), fleet, folder / "before.html", "joint")
    return (
        words[words.index("What vehicles of a model") :],
        told["lines"],
        (day, words_of(before)),
    )


def words_of(page):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page.read_text()))


def test_the_page_states_what_a_line_shares_and_names_the_vehicle_that_differs(night):
    words, _, _ = night
    found = re.search(r"radar elevation \+(\d\.\d+) \+- 0\.\d+ deg, or all mounts by as much", words)
    assert found is not None
    assert float(found[1]) == pytest.approx(0.8, abs=0.25)
    assert re.search(
        r"differ from their line: car-0007 \(lidar_radar: \d+\.\d sigmas from its line along rz\)", words
    )


def test_a_line_of_too_few_vehicles_is_one_sentence_on_the_page_and_a_count_in_the_summary(night):
    words, told, _ = night
    assert "Too few vehicles to learn from (six are needed): van has 4." in words
    assert told == {
        "status": {"default camera_lidar": "GREEN", "default lidar_radar": "GREEN"},
        "vehicles_that_differ": ["car-0007"],
        "too_few_vehicles": {"van": 4},
    }


KNOWN = r"azimuth (\d\.\d+), elevation (\d\.\d+) deg "


def test_the_pages_show_each_answer_alone_and_with_its_line_and_what_the_line_changes(night):
    words, _, (day, before) = night
    found = re.search(rf"car-0003 camera_lidar {KNOWN}{KNOWN}(\d\.\d+) deg, (\d\.\d+) m", words)
    alone, with_line, moved = (np.array([float(found[k]) for k in pair]) for pair in ((1, 2), (3, 4), (5, 6)))
    assert np.all(with_line < alone)
    assert np.all((moved > 0) & (moved < 0.3))
    assert re.search(
        rf"car-0007 lidar_radar {KNOWN}{KNOWN}0\.00 deg, 0\.000 m as alone: \d+\.\d sigmas", words
    )
    of_day = re.search(rf"and with the vehicle's model line .*camera_lidar {KNOWN}{KNOWN}", day)
    single = np.array([float(of_day[k]) for k in (1, 2)])
    assert np.all(single > alone)  # one day of three
    assert np.all(np.array([float(of_day[k]) for k in (3, 4)]) < single)
    assert "model line" not in before  # an earlier day: the line's answer is of the last one

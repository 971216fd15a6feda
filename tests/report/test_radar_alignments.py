"""What radars state of their own alignment, on the page of a day and in `boresight show`."""

import json

import numpy as np
import pytest

from jobs.show import show
from pipeline.config import FleetConfig
from pipeline.report.stage import write_day_page
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS
from schemas.radar_alignments import RADAR_ALIGNMENTS, RadarAlignment

DAY = Partition("v", "2026-03-01")
RIG = {"lidar": {"points": "/p"}, "radar": {"points": "/r", "alignment": "/radar/status"}}
FLEET = FleetConfig.model_validate({"fleet": {"name": "f"}, "rigs": {"default": RIG}, "vehicles": {"v": {}}})
NOON_NS = 1_772_366_400 * 10**9
ROW = RadarAlignment(
    vehicle="v", day=DAY.day, method="joint", sensor="radar", topics=["/radar/status"], messages=300, work_key="a",
    first_stamp_ns=NOON_NS, last_stamp_ns=NOON_NS + 3600 * 10**9, step_stamp_ns=NOON_NS + 60 * 10**9,
    azimuth_rad=np.radians(0.312), azimuth_sigma_rad=np.radians(0.05), azimuth_scatter_rad=np.radians(0.011),
    azimuth_step_rad=np.radians(0.3), elevation_rad=np.radians(-0.2), elevation_scatter_rad=np.radians(0.02),
    own_edge="lidar-radar", own_azimuth_rad=np.radians(0.28), own_azimuth_sigma_rad=np.radians(0.06),
    own_elevation_rad=np.radians(-0.5), own_elevation_sigma_rad=np.radians(0.3),
)  # fmt: skip


@pytest.fixture
def lake(tmp_path, maker):
    found = Lake.at(tmp_path / "lake")
    commit_records(found, CALIBRATIONS, maker.vehicle_records("v", 1, np.random.default_rng(1)))
    return found


def test_the_page_of_a_day_shows_both_with_both_sigmas(lake, tmp_path):
    commit_records(lake, RADAR_ALIGNMENTS, [ROW])
    page = write_day_page(lake, DAY, FLEET, tmp_path / "day.html").read_text()
    for words in (
        "Alignment stated by radars", "+0.312 ± 0.050 deg", "+0.280 ± 0.060 deg (lidar-radar)",
        "-0.200 deg (no sigma stated)", "-0.500 ± 0.300 deg (lidar-radar)", "+0.300 deg, at 12:01",
        "300, 12:00 to 13:00 UTC",
    ):  # fmt: skip
        assert words in page, words


def test_a_day_without_such_messages_has_no_such_table(lake, tmp_path):
    page = write_day_page(lake, DAY, FLEET, tmp_path / "day.html").read_text()
    assert "Alignment stated by radars" not in page


def test_show_prints_a_line_for_each_axis_and_the_current_row_alone_where_asked(lake, capsys):
    commit_records(lake, RADAR_ALIGNMENTS, [ROW])
    commit_records(lake, RADAR_ALIGNMENTS, [RadarAlignment(**{**vars(ROW), "messages": 7, "work_key": "b"})])
    where = str(lake.root)
    assert show("radar_alignments", lake=where, current=True) == 0
    printed = capsys.readouterr().out
    assert [
        w for w in ("azimuth", "elevation", "+0.312 ± 0.050 deg", "7, 12:00 to 13:00 UTC") if w not in printed
    ] == []
    assert show("radar_alignments", lake=where, current=True, json=True) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["messages"], row["own_edge"]) == (7, "lidar-radar")
    assert row["azimuth_rad"] == pytest.approx(np.radians(0.312))

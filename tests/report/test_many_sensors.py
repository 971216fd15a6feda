"""Pages of rigs of many sensors: charts, answers and tables by the names of sensors."""

import json
import re

import numpy as np
import pytest

from pipeline.core.config import load_fleet
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT
from pipeline.report.stage import write_day_page
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS
from tests.audit.fleet_records import vehicle_records
from tests.audit.test_many_sensors import RIGS, TURN
from tests.makers.fleet_pages import write_fleet_page
from tests.makers.rig_records import EDGES, rig_records

TITLES = [e.name for e in EDGES]


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """A van whose left camera was turned on 8 March, and a car of three sensors beside it."""
    folder = tmp_path_factory.mktemp("many")
    (folder / "fleet.toml").write_text(RIGS)
    lake, rng = Lake.at(folder / "lake"), np.random.default_rng(4)
    van = rig_records("van", 12, rng, motion=lambda d: {"left": TURN} if d > 6 else {})
    commit_records(lake, CALIBRATIONS, van)
    commit_records(lake, CALIBRATIONS, vehicle_records("car", 12, rng))
    fleet = load_fleet(folder / "fleet.toml")
    AUDIT.run(Task(fleet, lake, Window()))
    return lake, fleet


def test_the_fleet_page_has_a_chart_of_every_edge_under_its_name(lake, tmp_path):
    page = write_fleet_page(*lake, tmp_path / "fleet.html")
    index = json.loads(re.search(r'id="fleet">(.*?)</script>', page, re.DOTALL)[1])
    assert set(TITLES) < set(index["pairs"])
    charts = index["charts"]["inside"]
    assert {index["pairs"][c[0]] for c in charts["van"]["charts"]} == set(TITLES)
    three = {"camera-lidar", "camera-radar", "lidar-radar"}
    assert {index["pairs"][c[0]] for c in charts["car"]["charts"]} == three
    for k, *_, values, _sigmas in charts["van"]["charts"]:
        assert len(values) == 12
        assert charts["van"]["pairs"][k] == "a" * 12
    assert "van: left since 2026-03-08" in page
    assert "The left moved on 2026-03-08" in page
    assert re.search(r"Its motion: yaw \+0\.\d+ ", page)  # a camera's own axes, though it is called left


def test_a_day_s_page_tells_of_every_edge_and_which_of_them_a_moved_sensor_takes_along(lake, tmp_path):
    tables, fleet = lake
    page = write_day_page(tables, Partition("van", "2026-03-05"), fleet, tmp_path / "day.html").read_text()
    for edge in EDGES:
        assert f"<h3>{edge.name} " in page
        assert f"T_{edge.parent.name}_{edge.child.name}</strong>" in page
        assert page.count(f'id="json-{edge.parent.name}_{edge.child.name}"') == 1
    assert "Not any more. The left moved on 2026-03-08, after this day." in page
    still = ", ".join(title for title in TITLES if "left" not in title)
    assert f"Only {still} still holds." in page

"""A day's page of a rig with several cameras: a picture of each, from its own image and edge."""

import base64
import re

import cv2
import numpy as np

from pipeline.core.config import load_fleet
from pipeline.report.reading import drawn_records, names_drawn, other_cameras
from pipeline.report.stage import write_day_page
from pipeline.rig.graph import words_of
from pipeline.store.partitions import Lake
from tests.audit.test_many_sensors import RIGS
from tests.export.test_foxglove_rig import DAY, lake  # noqa: F401 - a fixture
from tests.makers.rig_records import EDGES, rig_records


def test_records_are_drawn_of_the_first_sensors_and_of_every_other_camera_with_its_lidar():
    records = rig_records("van", 1, np.random.default_rng(1))
    rows = dict(zip(map(words_of, EDGES), records, strict=True))
    first = drawn_records(rows)
    assert names_drawn(first) == {"camera": "front", "lidar": "top", "radar": "bumper"}
    assert other_cameras(rows, first) == ["left"]
    assert names_drawn(drawn_records(rows, "left")) == {"camera": "left", "lidar": "top"}


def test_the_page_has_a_picture_of_every_camera(lake, tmp_path):  # noqa: F811
    (tmp_path / "fleet.toml").write_text(RIGS)
    fleet = load_fleet(tmp_path / "fleet.toml")
    page = write_day_page(Lake.at(lake), DAY, fleet, tmp_path / "day.html").read_text()
    found = re.findall(
        r'(?s)<h3>(front|left)</h3>\s*<figure class="flip">.*?<img src="data:image/jpeg;base64,([^"]+)"', page
    )
    names = [name for name, _ in found]
    assert names == ["front", "front", "front", "left"]
    front, left = (cv2.imdecode(np.frombuffer(base64.b64decode(found[k][1]), np.uint8), 1) for k in (0, 3))
    assert front.shape == left.shape
    assert np.abs(front.astype(int) - left.astype(int)).mean() > 1  # two cameras' images

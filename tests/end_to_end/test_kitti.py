"""KITTI: a real street whose labels mistake car windows for no border, from folder to records that are not wrong."""

import numpy as np
import pytest

from jobs.cli import main
from pipeline.calibrate.records import Inputs
from pipeline.core.config import load_fleet
from pipeline.rig.day_prior import read_prior
from pipeline.rig.targets import errors_at_targets
from pipeline.store.current import targets_of, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.views import observations_of
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from tests.makers.calibrated_days import perturbed, records_of_rows
from tests.makers.kitti_street import converted_street

pytestmark = [pytest.mark.real_logs, pytest.mark.slow]
DAY = Partition("kitti-1", "2011-09-26")
START = (2.0, 0.05)  # deg and m that the given transform is off by
REFERENCE_DEG = 0.1  # how well the given calibration is known


@pytest.fixture(scope="module")
def night(kitti_logs, real_segmenter, real_detector, tmp_path_factory):
    """Folder of a night of the street, which came out of KITTI's own layout."""
    out = tmp_path_factory.mktemp("kitti")
    (log,) = kitti_logs.glob("*.mcap")
    converted_street(log, out, DAY, (real_segmenter, real_detector))
    logs = f"{out}/logs/{{vehicle}}/{{day}}/*.mcap"
    call = ["nightly", "--fleet", str(out / "fleet.toml"), "--lake", str(out / "lake"), "--logs", logs]
    assert main([*call, "--executor", "inline", "--report", str(out / "pages" / "fleet.html")]) in (0, 3)
    return out


@pytest.fixture(scope="module")
def street(night):
    """Fleet and observations of the street."""
    rows = list(observations_of(Lake.at(night / "lake"), DAY))
    assert len(rows) == 26
    return load_fleet(night / "fleet.toml"), rows


def test_a_night_without_a_radar_goes_from_kitti_s_folder_to_pages(night):
    (record,) = read_records(Lake.at(night / "lake"), CALIBRATIONS, CalibrationRecord, vehicle=DAY.vehicle)
    assert (record.pair, record.frames_used >= 8) == ("camera_lidar", True)  # the street shows two scenes
    assert record.status in ("accepted", "held"), record.reason
    pages = {p.name: p.read_text() for p in (night / "pages").rglob("*.html")}
    assert "fleet.html" in pages
    assert DAY.vehicle in pages["fleet.html"]
    assert any(DAY.day in text and "camera" in text for name, text in pages.items() if name != "fleet.html")


@pytest.mark.parametrize("seed", range(4))
def test_no_start_is_certified_beyond_what_is_right(street, seed):
    fleet, rows = street
    given = read_prior(rows, fleet, DAY.vehicle)
    about = Inputs(DAY, "joint", "test", seed, (), pairs=("camera_lidar",))
    (record,) = records_of_rows(rows, perturbed(given, START, seed), fleet, about)
    T = transform_of(record)
    assert T is not None
    errors = np.degrees(errors_at_targets("camera_lidar", T, given.T_camera_lidar, targets_of(record))[:2])
    sigma = np.degrees([record.azimuth_sigma_rad, record.elevation_sigma_rad])
    for k, direction in enumerate(("azimuth", "elevation")):
        assert direction not in record.determined or errors[k] < np.hypot(3 * sigma[k], REFERENCE_DEG)

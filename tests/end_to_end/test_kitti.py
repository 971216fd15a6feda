"""KITTI: a real street whose labels mistake car windows for no border, from its log to records that are not wrong."""

import numpy as np
import pytest

from pipeline.calibrate.records import Inputs
from pipeline.calibrate.stage import calibrate_observations
from pipeline.config import load_fleet
from pipeline.extrinsics.prior import perturbed, read_prior
from pipeline.geometry.targets import errors_at_targets
from pipeline.store.current import targets_of
from pipeline.store.partitions import Lake, Partition
from tests.benchmarks.studies.metrics import transform_of
from tests.makers.real_models import write_real_manifests
from tests.makers.simulated_days import perceived

pytestmark = [pytest.mark.real_logs, pytest.mark.slow]
DAY = Partition("kitti-1", "2011-09-26")
START = (2.0, 0.05)  # deg and m that the given transform is off by
REFERENCE_DEG = 0.1  # how well the given calibration is known
FLEET = """
[fleet]
name = "kitti"
[rigs.default.camera]
image = "/camera/front/image/compressed"
info = "/camera/front/camera_info"
semantics = { source = "onnx", segmenter = "segmenter.toml", detector = "detector.toml" }
[rigs.default.lidar]
points = "/lidar/top/points"
[rigs.default.prior]
source = "tf_static"
rotation_sigma_deg = 2.0
translation_sigma_m = 0.05
[vehicles."kitti-1"]
rig = "default"
"""


@pytest.fixture(scope="module")
def street(kitti_logs, real_segmenter, real_detector, tmp_path_factory):
    """Fleet and observations of the street."""
    folder = tmp_path_factory.mktemp("kitti")
    write_real_manifests(folder, real_segmenter, real_detector)
    fleet_file = folder / "fleet.toml"
    fleet_file.write_text(FLEET)
    rows = perceived(
        fleet_file, Lake.at(folder / "lake"), DAY, sorted(kitti_logs.glob("*.mcap")), folder
    ).observations
    assert len(rows) == 26
    return load_fleet(fleet_file), rows


@pytest.mark.parametrize("seed", range(4))
def test_no_start_is_certified_beyond_what_is_right(street, seed):
    fleet, rows = street
    given = read_prior(rows, fleet, DAY.vehicle)
    about = Inputs(DAY, "joint", "test", seed, (), pairs=("camera_lidar",))
    (record,) = calibrate_observations(rows, perturbed(given, START, seed), fleet, about)
    T = transform_of(record)
    assert T is not None
    errors = np.degrees(errors_at_targets("camera_lidar", T, given.T_camera_lidar, targets_of(record))[:2])
    sigma = np.degrees([record.azimuth_sigma_rad, record.elevation_sigma_rad])
    for k, direction in enumerate(("azimuth", "elevation")):
        assert direction not in record.determined or errors[k] < np.hypot(3 * sigma[k], REFERENCE_DEG)

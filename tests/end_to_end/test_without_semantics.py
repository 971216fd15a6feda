"""Real logs whose fleet.toml names no semantics, from logs to the record of camera-lidar."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.records import Inputs
from pipeline.core.config import load_fleet
from pipeline.rig.day_prior import read_prior
from pipeline.rig.targets import errors_at_targets
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.observations import WITHOUT_LABELS
from tests.accuracy.days import SHARED
from tests.benchmarks.studies.metrics import LIMITS_DEG
from tests.makers.calibrated_days import perturbed, records_of_rows
from tests.makers.stages import ingest_day, perceive_day

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (SHARED / "astyx").is_dir(), reason="the recordings are not beside this repository"
    ),
]
RIG = """
[fleet]
name = "without-semantics"
[vehicles."{vehicle}"]
rig = "default"
[rigs.default.camera]
image = "/camera/front/image/compressed"
info = "/camera/front/camera_info"
[rigs.default.lidar]
points = "/lidar/top/points"
[rigs.default.prior]
source = "tf_static"
"""
RADAR = """
[rigs.default.radar]
points = "/radar/front/points"
doppler_field = "doppler"
"""
ASTYX = 'doppler_positive = "approaching"\ndoppler_period_mps = 10.394\n'
OTHER = 'doppler_positive = "receding"\n[rigs.default.ego]\nodometry = "/vehicle/odometry"\n'
# By log: files, vehicle-day, fleet.toml beyond camera and lidar, and how far from the truth its reference may be [deg].
LOGS = {
    "other_world": ("other_world/*.mcap", Partition("veh00", "2026-03-02"), RADAR + OTHER, 0.0),
    "real_car": ("astyx/astyx-1_*", Partition("astyx-1", "2019-01-14"), RADAR + ASTYX, 0.2),
    "kitti": ("kitti/*.mcap", Partition("kitti-1", "2011-09-26"), "", 0.1),
}
# From every start; the real car is held from some, whose azimuth is known to .08 deg.
ACCEPTED = {"other_world"}


@pytest.fixture(scope="module")
def day(request, tmp_path_factory):
    """Observations without labels, and the truth; of real cars the logged calibration."""
    name, folder = request.param, tmp_path_factory.mktemp(request.param)
    files, partition, extra, _ = LOGS[name]
    if not (logs := sorted(SHARED.glob(files))):
        pytest.skip(f"no recordings of {name} beside this repository")
    (folder / "fleet.toml").write_text(RIG.format(vehicle=partition.vehicle) + extra)
    fleet, lake = load_fleet(folder / "fleet.toml"), Lake.at(folder / "lake")
    ingest_day(logs, partition, fleet, lake)
    perceive_day(partition, fleet, lake)
    rows = list(observations_of(lake, partition))
    given, truth = read_prior(rows, fleet, partition.vehicle), (SHARED / files).parent / "truth.json"
    if truth.exists():
        known = {k: np.array(T) for k, T in json.loads(truth.read_text()).items() if k.startswith("T_")}
        given = replace(given, T_camera_lidar=known["T_camera_lidar"], T_lidar_radar=known["T_lidar_radar"])
    return name, rows, fleet, given


def found_from(rows, fleet, true, deg, seed, *, is_hidden=False):
    """The record of camera-lidar from a start that is turned by `deg`; a hidden one states the sigmas of the truth."""
    start = perturbed(true, (deg, 0.025 * deg), seed)
    if is_hidden:
        start = replace(start, **{k: getattr(true, k) for k in ("rotation_sigma_rad", "translation_sigma_m")})
    inputs = Inputs(Partition("any", "2026-03-02"), "joint", "test", seed, (), pairs=("camera_lidar",))
    [record] = records_of_rows(rows, start, fleet, inputs)
    return record


def off_deg(record, true):
    errors = errors_at_targets("camera_lidar", transform_of(record), true.T_camera_lidar)
    return float(np.degrees(errors[:2].max()))


@pytest.mark.parametrize("day", ["real_car", "other_world"], indirect=True)
def test_a_real_log_without_labels_is_right_from_two_degrees_and_says_how(day):
    name, rows, fleet, true = day
    assert all(o.is_unlabelled for o in rows if "camera" in o.sensors)
    record = found_from(rows, fleet, true, 2.0, 41)
    unsure_only = record.diagnostics["unsure_only"] > 0
    assert record.status == "accepted" or (unsure_only and name not in ACCEPTED), record.reason
    assert off_deg(record, true) < LIMITS_DEG["camera_lidar"] + LOGS[name][3]
    assert WITHOUT_LABELS in record.notes


@pytest.mark.parametrize("day", ["real_car", "kitti"], indirect=True)
@pytest.mark.parametrize("is_hidden", [False, True])
def test_a_start_far_off_is_not_accepted_wrong(day, is_hidden):
    name, rows, fleet, true = day
    record = found_from(rows, fleet, true, 5.0, 42, is_hidden=is_hidden)
    is_right = off_deg(record, true) < LIMITS_DEG["camera_lidar"] + LOGS[name][3]
    assert record.status != "accepted" or is_right, record.reason

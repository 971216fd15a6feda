"""The real vehicle-day from its logs to records: `joint` finds the given calibration again, to the README's bounds."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.calibrate.day import calibrate_observations
from pipeline.calibrate.records import Inputs
from pipeline.core.config import load_fleet
from pipeline.rig.day_prior import perturbed, read_prior
from pipeline.rig.estimates import Prior
from pipeline.rig.targets import errors_at_targets
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CalibrationRecord
from schemas.observations import Observation
from tests.benchmarks.studies.metrics import transform_of
from tests.makers.simulated_days import perceived

pytestmark = [pytest.mark.real_logs, pytest.mark.slow]
FLEET = Path(__file__).parent / "astyx.toml"
DAY = Partition("astyx-1", "2019-01-14")
START = (2.0, 0.1)  # deg and m that both transforms are off by
SEED = 0


@pytest.fixture(scope="module")
def rows(real_logs, tmp_path_factory) -> list[Observation]:
    """All frames of the day, ingested and perceived."""
    folder = tmp_path_factory.mktemp("real")
    logs = sorted(real_logs.glob("astyx-1_*"))
    found = perceived(FLEET, Lake.at(folder / "lake"), DAY, logs, folder).observations
    assert len(found) == 187
    return found


@pytest.fixture(scope="module")
def solved(rows) -> tuple[Prior, dict[str, CalibrationRecord]]:
    """The given calibration, and what `joint` made of the day, pair by pair.

    Every second frame is calibrated, which is half of the time.
    """
    fleet = load_fleet(FLEET)
    given = read_prior(rows, fleet, DAY.vehicle)
    records = calibrate_observations(
        rows[::2], perturbed(given, START, SEED), fleet, Inputs(DAY, "joint", "test", SEED, ())
    )
    return given, {record.pair: record for record in records}


@pytest.fixture(scope="module")
def errors(solved) -> dict[str, tuple[float, float, float]]:
    """Azimuth, elevation [deg] and range [m] between `joint` and the given calibration, pair by pair."""
    given, records = solved
    found = {}
    for record in records.values():
        T = transform_of(record)
        assert T is not None, record.reason
        azimuth, elevation, range_m = errors_at_targets(record.pair, T, given.of(record.pair))
        found[record.pair] = (float(np.degrees(azimuth)), float(np.degrees(elevation)), float(range_m))
    return found


def test_camera_lidar_comes_back_to_the_given_calibration(errors):
    azimuth_deg, elevation_deg, _ = errors["camera_lidar"]
    assert azimuth_deg <= 0.15
    assert elevation_deg <= 0.20


def test_radar_azimuth_and_range_come_back_to_the_given_calibration(errors):
    assert errors["lidar_radar"][0] <= 0.35
    assert errors["camera_radar"][0] <= 0.35
    assert errors["lidar_radar"][2] <= 0.10


def test_the_radars_elevation_has_witnesses_that_agree_and_a_sigma_of_half_a_degree_at_most(solved, errors):
    _, records = solved
    record = records["lidar_radar"]
    said = record.diagnostics
    apart = said["doppler_pitch_offset_rad"] - said["registration_pitch_offset_rad"]
    assert abs(apart) <= 2 * np.hypot(said["doppler_pitch_sigma_rad"], said["registration_pitch_sigma_rad"])
    assert said["doppler_frames"] >= 40
    # The camera's boxes, which have a say in no other pair.
    assert records["camera_radar"].diagnostics["boxes"] >= 40
    assert record.loop_rotation_rad <= 3 * record.loop_rotation_sigma_rad
    assert errors["lidar_radar"][1] <= 0.6
    assert record.elevation_sigma_rad <= np.radians(0.5)


def test_ten_frames_that_lead_to_a_wrong_place_are_contradicted_by_those_held_out(rows):
    """From this start 5 deg off ten frames match best 1.4 deg beside the right place, and the radar rested on it."""
    fleet = load_fleet(FLEET).changed(select={"frames": 10})
    given = read_prior(rows, fleet, DAY.vehicle)
    prior = perturbed(given, (5.0, 0.1), 22)
    records = calibrate_observations(rows, prior, fleet, Inputs(DAY, "joint", "test", 22, ()))
    for record in records:
        T = transform_of(record)
        if record.status == "accepted" and T is not None:
            azimuth = errors_at_targets(record.pair, T, given.of(record.pair))[0]
            assert np.degrees(azimuth) < (0.2 if record.pair == "camera_lidar" else 0.4), record.pair
    reasons = {record.pair: record.reason for record in records}
    assert "the held-out frames, which are more than those of the fit" in reasons["camera_lidar"]

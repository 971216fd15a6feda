"""From the simulator through logs, ingest and perceive to `joint`: the result is near the truth, not only plausible."""

import pytest

from tests.benchmarks.studies.days import Day, DaySpec
from tests.benchmarks.studies.engine import Run, calibrate_once
from tests.makers.simulated_days import simulated_day

# A day that nothing was chosen on: bounds come from what is promised, not from what this day shows. Angles: what an
# accepted record certifies (pipeline/calibrate/verify/limits.py); elevation of radar pairs: four times the constant
# elevation error that the simulator draws for a radar (0.15 deg); range: no worse than the start.
SPEC = DaySpec(4900, "urban", 32, "demo")
BOUNDS_DEG = {"camera_lidar": (0.2, 0.2), "camera_radar": (0.4, 0.6), "lidar_radar": (0.4, 0.6)}
RANGE_M = 0.10
# Both sensors measure so much beside their stamps that the sign of what is found counts [s].
CLOCKS = "vehicle-1:0:camera:time:0.03,vehicle-1:0:radar:time:-0.03"


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """The demo's rig, 32 frames, both transforms started exactly 2 deg and 0.1 m off."""
    folder = tmp_path_factory.mktemp("day")
    about = {"frames": SPEC.frames, "environment": SPEC.environment, "seed": SPEC.seed}
    made = simulated_day(folder, faults=CLOCKS, **about)
    day = Day(SPEC, made.observations, made.told, made.fleet, {})
    return calibrate_once(Run(SPEC, prior=("exact", 2.0, 0.1), seed=SPEC.seed), day)["pairs"]


@pytest.mark.slow
@pytest.mark.parametrize("pair", BOUNDS_DEG)
def test_a_simulated_day_is_calibrated_to_its_truth(pairs, pair):
    azimuth_deg, elevation_deg = BOUNDS_DEG[pair]
    assert pairs[pair]["az_deg"] <= azimuth_deg
    assert pairs[pair]["el_deg"] <= elevation_deg
    assert pairs[pair]["prior_az_deg"] > azimuth_deg or pairs[pair]["prior_el_deg"] > elevation_deg


@pytest.mark.slow
def test_the_range_between_lidar_and_radar_is_right(pairs):
    assert pairs["lidar_radar"]["range_m"] <= RANGE_M


@pytest.mark.slow
@pytest.mark.parametrize("pair", ["camera_lidar", "lidar_radar"])
def test_the_record_s_time_offset_is_the_truth_s_with_its_sign(pairs, pair):
    found = pairs[pair]
    assert abs(found["dt_s"] - found["dt_true_s"]) < 3 * found["dt_sigma_s"]
    assert abs(-found["dt_s"] - found["dt_true_s"]) > 4 * found["dt_sigma_s"]

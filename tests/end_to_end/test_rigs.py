"""Other cars' sensors go from the simulator through logs, ingest, perceive and `joint` without a stumble."""

import numpy as np
import pytest

from pipeline.ingest.check import check_logs
from pipeline.store.views import perceived
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import Day, DaySpec
from tests.benchmarks.studies.engine import Run, calibrate_once
from tests.makers.simulated_days import DATE, simulated_day

# Rings that the logs are found to have: a rosette's lasers are none.
RINGS = {"corner-left": 32, "rosette": 0, "fisheye": 32}
FRAMES = 14  # a dozen is the least that can be split into solving and judging


@pytest.fixture(scope="module", params=RINGS)
def day(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    made = simulated_day(folder, frames=FRAMES, rig=request.param, seed=190)
    return request.param, folder, made


@pytest.mark.slow
def test_a_rig_unlike_the_paper_s_is_perceived_whole(day):
    rig, folder, made = day
    assert len(made.observations) >= FRAMES - 1
    for o in made.observations:
        assert len(o.lidar_edge_xyz_m) > 100
        assert o.ground_plane is not None
    without_rows = perceived(made.lake, made.partition).kept.get("frames_without_lidar_rows", 0)
    assert without_rows == (len(made.observations) if RINGS[rig] == 0 else 0)
    logs = sorted((folder / "logs" / "vehicle-1" / DATE).iterdir())
    report = check_logs(logs, made.fleet.rig_of("vehicle-1"), made.fleet)
    assert report.evidence.rings == RINGS[rig]


@pytest.mark.slow
def test_a_rig_unlike_the_paper_s_ends_in_a_record_of_every_pair(day):
    rig, _, made = day
    spec = DaySpec(190, "urban", FRAMES, rig)
    result = calibrate_once(
        Run(spec, prior=("exact", 1.0, 0.02), seed=1), Day(spec, made.observations, made.told, made.fleet, {})
    )
    assert set(result["pairs"]) == set(PAIRS)
    # So few frames seldom suffice to accept it, but the camera finds its place in the lidar's frame.
    camera_lidar = result["pairs"]["camera_lidar"]
    assert camera_lidar["status"] in {"accepted", "held"}
    assert np.hypot(camera_lidar["az_deg"], camera_lidar["el_deg"]) < 0.6

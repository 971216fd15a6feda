"""A vehicle-day after ingest: perceive per frame and calibrate, in units of a naive NumPy objective in this process."""

import time

import pytest

from pipeline.core.config import load_fleet
from pipeline.simulate.fleet import FleetSpec, simulate_fleet
from pipeline.store.partitions import Lake, Partition
from tests.benchmarks.kernel_workload import FRAMES, POINTS, naive_cpu_s
from tests.makers.stages import calibrate_day, ingest_day, perceive_day

SIMULATED_FRAMES = 40
DAY = Partition("vehicle-1", "2026-03-02")


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """A day of the demo rig in the lake, its fleet, and CPU seconds per frame of perceiving it."""
    out = tmp_path_factory.mktemp("day")
    simulate_fleet(FleetSpec(vehicles=1, days=1, first_day=DAY.day, frames=SIMULATED_FRAMES), out)
    fleet, lake = load_fleet(out / "fleet.toml"), Lake.at(out / "lake")
    ingest_day(sorted((out / "logs" / DAY.vehicle / DAY.day).iterdir()), DAY, fleet, lake)
    perceive_day(DAY, fleet, lake)  # warms caches up
    other = Lake.at(out / "lake2")
    ingest_day(sorted((out / "logs" / DAY.vehicle / DAY.day).iterdir()), DAY, fleet, other)
    began = time.process_time()
    rows = perceive_day(DAY, fleet, other).rows
    assert rows >= 0.8 * SIMULATED_FRAMES
    return lake, fleet, out / "fleet.toml", (time.process_time() - began) / rows


@pytest.mark.slow
def test_perceiving_a_frame_costs_few_naive_objectives(day, gate):
    perceive_s, unit_s = day[-1], naive_cpu_s() / (FRAMES * POINTS) * 1e5
    print(
        f"\nperceive {perceive_s:.3f} CPU s a frame of the demo rig; naive NumPy, 100,000 points: {unit_s:.4f}"
    )
    gate("perceive_vs_numpy", perceive_s / unit_s)


@pytest.mark.slow
def test_calibrating_a_day_costs_few_naive_objectives(day, gate):
    lake, fleet, *_ = day
    spent = []
    for seed in (0, 1, 2):  # another seed is other work; the first one compiles
        began = time.process_time()
        result = calibrate_day(DAY, fleet, lake, seed=seed)
        spent.append(time.process_time() - began)
        assert result.status == "done"
    unit_s = naive_cpu_s() / (FRAMES * POINTS) * 1e5
    print(f"\ncalibrate {min(spent):.1f} CPU s for {SIMULATED_FRAMES} frames; naive NumPy: {unit_s:.4f}")
    gate("calibrate_vs_numpy", min(spent) / unit_s)

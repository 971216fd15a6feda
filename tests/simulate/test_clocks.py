"""Sensors without a common trigger, and stamps that are late: what the log then holds."""

from dataclasses import replace

import numpy as np

from pipeline.rig.topics import TOPICS
from pipeline.simulate.fleet import FleetSpec, simulate_vehicle_day
from pipeline.simulate.logs.recording import free_clocks
from pipeline.simulate.sensors.rigs import rig_named

SHORT = {"vehicles": 1, "days": 1, "drives": 1, "environments": "urban"}


def test_free_clocks_drift_through_all_gaps_even_where_rates_are_multiples():
    clocks = free_clocks(rig_named("paper-free"), np.random.default_rng(0))
    camera = clocks["camera"]
    sweeps = [clocks["lidar"].nearest(t)[0] for t in np.arange(0, 60, 0.5)]
    gaps = np.array([camera.nearest(t)[0] - t for t in sweeps])
    assert np.abs(gaps).max() <= camera.period_s / 2 + 1e-12
    assert np.ptp(gaps) > 0.9 * camera.period_s


def stamps_of(read, log, topic):
    return np.array([t for name, t, _ in read(log) if name == topic]) * 1e-9


def test_a_free_running_log_holds_the_nearest_image_and_scan_and_some_that_are_not(
    tmp_path, read, the_log, monkeypatch
):
    rates = {s.name: s.rate_hz for s in rig_named("paper-free").sensors}
    free = rig_named("demo").changed(lambda s: replace(s, rate_hz=rates[s.name]))
    monkeypatch.setattr("pipeline.simulate.fleet.rig_named", lambda _: free)
    simulate_vehicle_day(FleetSpec(**SHORT, frames=5), 0, 0, tmp_path)
    log = the_log(tmp_path)
    sweeps, images, scans = (stamps_of(read, log, TOPICS[n]) for n in ("lidar", "image", "radar"))
    assert len(sweeps) == 5
    assert (len(images), len(scans)) == (7, 7)  # with the first and the fifth sweep two of each
    for stamps, period_s in ((images, 1 / 30), (scans, 1 / 13)):
        nearest = np.abs(stamps - sweeps[:, None]).min(1)
        assert nearest.max() <= 0.51 * period_s
        assert nearest.max() > 0.005

"""Logs of a simulated day: the same for a seed, in every container, whole or not at all, by their sensors' clocks."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jobs.simulate import simulate_days
from pipeline.core.config import load_fleet
from pipeline.rig.topics import TOPICS
from pipeline.simulate.fleet import FleetSpec, simulate_fleet, simulate_vehicle_day
from pipeline.simulate.logs.recording import SUFFIXES, free_clocks, open_log
from pipeline.simulate.reflectors import simulate_reflectors
from pipeline.simulate.sensors.rigs import rig_named

SMALL = {"vehicles": 1, "days": 1, "frames": 2, "drives": 1, "environments": "urban"}


@pytest.fixture(scope="module")
def mcap_day(tmp_path_factory):
    out = tmp_path_factory.mktemp("mcap")
    simulate_fleet(FleetSpec(**SMALL), out)
    return out


def test_the_same_seed_gives_the_same_bytes_whatever_the_size_of_the_fleet_and_another_does_not(
    mcap_day, tmp_path, read, the_log
):
    simulate_vehicle_day(FleetSpec(**SMALL | {"vehicles": 5, "days": 9}), 0, 0, tmp_path / "again")
    simulate_vehicle_day(FleetSpec(**SMALL | {"frames": 1}, seed=2), 0, 0, tmp_path / "other")
    assert the_log(tmp_path / "again").read_bytes() == the_log(mcap_day).read_bytes()
    clouds = [
        next(bytes(m.data) for topic, _, m in read(the_log(out)) if topic == TOPICS["lidar"])
        for out in (tmp_path / "other", mcap_day)
    ]
    assert clouds[0] != clouds[1]


@pytest.mark.parametrize("container", ["ros1", "db3"])
def test_containers_hold_the_same_messages(container, mcap_day, tmp_path, read, the_log):
    simulate_vehicle_day(FleetSpec(**SMALL, container=container), 0, 0, tmp_path)
    expected, found = read(the_log(mcap_day)), read(the_log(tmp_path))
    order = [(topic, stamp) for topic, stamp, _ in expected]
    assert sorted(order) == sorted((topic, stamp) for topic, stamp, _ in found)
    by_key = {(topic, stamp): message for topic, stamp, message in found}
    for topic, stamp, message in expected:
        other = by_key[topic, stamp]
        if hasattr(message, "data"):
            np.testing.assert_array_equal(message.data, other.data)
        if topic == TOPICS["info"]:
            np.testing.assert_array_equal(message.k, other.K if container == "ros1" else other.k)
        if topic == TOPICS["detections"]:
            assert [d.bbox.size_x for d in message.detections] == [d.bbox.size_x for d in other.detections]


def test_the_fleet_file_names_every_vehicle_and_doppler_signs_follow_it(mcap_day, tmp_path, read, the_log):
    simulate_fleet(FleetSpec(**SMALL | {"vehicles": 2, "frames": 1}, rig="ring16"), tmp_path)
    fleet = load_fleet(tmp_path / "fleet.toml")
    assert set(fleet.vehicles) == {"vehicle-1", "vehicle-2"}
    radar = fleet.rig_of("vehicle-1").radar
    assert (radar.doppler_period_mps, radar.doppler_positive) == (10.394, "approaching")

    def doppler(out):
        cloud = next(m for topic, _, m in read(the_log(out)) if topic == TOPICS["radar"])
        rows = np.frombuffer(cloud.data.tobytes(), [(f.name, "<f4") for f in cloud.fields])
        return rows["doppler"][np.abs(rows["y"]) < 0.3 * rows["x"]]

    # We drive ahead at 5-15 m/s: most of the world comes nearer.
    assert np.median(doppler(mcap_day)) < -2
    assert np.abs(doppler(tmp_path)).max() <= 10.394 / 2 + 0.1


@pytest.mark.slow
def test_workers_give_what_one_process_gives(mcap_day, tmp_path, the_log):
    assert simulate_days(FleetSpec(**SMALL), tmp_path, "synthetic", workers=2) == 1
    assert the_log(tmp_path).read_bytes() == the_log(mcap_day).read_bytes()


def test_reflectors_are_picked_where_all_sensors_agree_under_the_truth(tmp_path, read):
    spec = FleetSpec(vehicles=1, days=1)
    path = simulate_reflectors(spec, 0, 0, tmp_path, frames=12)
    picks = json.loads(path.read_text())
    lidar, radar, pixels = (
        np.array([t[k] for t in picks["targets"]]) for k in ("lidar_m", "radar_m", "pixel")
    )
    T = np.array(picks["truth"]["T_lidar_radar"])
    assert len(lidar) == 3
    offset = np.linalg.norm(radar @ T[:3, :3].T + T[:3, 3] - lidar, axis=1)
    assert np.all(offset < 0.1 + 0.02 * np.linalg.norm(lidar, axis=1))  # 6 deg of elevation resolution
    # A trihedral's echo comes from its apex: at every distance the same range error, the radar's own.
    range_error_m = np.linalg.norm(radar, axis=1) - np.linalg.norm(picks["truth"]["radar_m"], axis=1)
    assert np.ptp(range_error_m) < 0.06
    assert np.abs(pixels - np.array(picks["truth"]["pixels"])).max() < 2
    messages = read(path.with_suffix(".mcap"))
    assert sum(topic == TOPICS["lidar"] for topic, _, _ in messages) == 12


@pytest.mark.parametrize("container", SUFFIXES)
def test_a_log_that_is_broken_off_leaves_the_old_one_and_nothing_else(container, tmp_path, read):
    path = tmp_path / f"drive{SUFFIXES[container]}"
    nominal = {"lidar": np.eye(4)}
    with open_log(path, container) as (messages, put):
        put(TOPICS["tf"], 5, messages.sensor_poses(5, nominal))
    before = sorted(p for p in tmp_path.rglob("*"))

    class StopError(Exception):
        pass

    with pytest.raises(StopError), open_log(path, container) as (messages, put):
        put(TOPICS["tf"], 7, messages.sensor_poses(7, nominal))
        raise StopError
    assert sorted(p for p in tmp_path.rglob("*")) == before
    assert [stamp for _, stamp, _ in read(path)] == [5]


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
    simulate_vehicle_day(FleetSpec(**SMALL | {"frames": 5}), 0, 0, tmp_path)
    log = the_log(tmp_path)
    sweeps, images, scans = (stamps_of(read, log, TOPICS[n]) for n in ("lidar", "image", "radar"))
    assert len(sweeps) == 5
    assert (len(images), len(scans)) == (7, 7)  # with the first and the fifth sweep two of each
    for stamps, period_s in ((images, 1 / 30), (scans, 1 / 13)):
        nearest = np.abs(stamps - sweeps[:, None]).min(1)
        assert nearest.max() <= 0.51 * period_s
        assert nearest.max() > 0.005

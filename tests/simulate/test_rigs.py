"""Rigs that differ from the paper's: laws of their sensors, seen through one simulated trio each."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.core.config import load_fleet
from pipeline.simulate.fleet import FleetSpec, drive_of, fleet_toml
from pipeline.simulate.sensors.camera import RollingShutter, view_of
from pipeline.simulate.sensors.lidar import beams_of
from pipeline.simulate.sensors.mounting import mounting_of
from pipeline.simulate.sensors.rigs import RIGS, rig_named
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive

SHORT = [name for name, rig in RIGS.items() if rig.is_short]
every_rig = pytest.mark.parametrize("name", [*SHORT, "random-7003", "random-7004"])


@every_rig
def test_a_rig_has_a_fleet_file_and_true_poses_near_its_drawings(name, tmp_path):
    rig = rig_named(name)
    (tmp_path / "fleet.toml").write_text(fleet_toml("f", {"v": rig}))
    radar = load_fleet(tmp_path / "fleet.toml").rig_of("v").radar
    assert radar.doppler_period_mps == rig["radar"].sheet.doppler_period_mps
    mounting = mounting_of(rig, 3, 0, 0)
    for sensor in ("camera", "lidar", "radar"):
        true, drawn = mounting[sensor].T_vehicle, mounting[sensor].T_vehicle_nominal
        turn = np.degrees(np.arccos(np.clip((np.trace(true[:3, :3].T @ drawn[:3, :3]) - 1) / 2, -1, 1)))
        assert 0 < turn < 4
        assert np.linalg.norm(true[:3, 3] - drawn[:3, 3]) < 0.15


@every_rig
def test_a_camera_is_as_wide_and_as_high_as_its_data_sheet(name):
    sheet = rig_named(name)["camera"].sheet
    camera = replace(sheet, distortion=(0.0,) * len(sheet.distortion)).nominal()
    border = np.array([[-0.5, camera.K[1, 2]], [camera.K[0, 2], -0.5]])
    x, y, z = camera.unproject(border).T
    angles_deg = np.degrees(np.arctan2(np.hypot(x, y), z))
    np.testing.assert_allclose(2 * angles_deg, [sheet.horizontal_deg, sheet.vertical_deg], atol=1e-6)


def test_a_rig_named_by_its_rows_has_so_many_over_so_many_degrees():
    sheet = rig_named("rows-32-60-dirty")["lidar"].sheet
    assert (sheet.rows, sheet.azimuth_deg) == (32, (-30.0, 30.0))
    assert np.diff(sheet.elevation_deg)[0] / (sheet.rows - 1) == 1.0


def test_random_rigs_are_of_all_kinds_and_a_seed_s_own():
    rigs = [rig_named(f"random-{seed}") for seed in range(40)]
    assert rigs[7] == rig_named("random-7")
    assert not rig_named("random-7-flat")["radar"].sheet.has_elevation
    assert rig_named("random-7-dirty")["radar"].sheet.road_mirror > 0
    cameras, lidars = ([rig[kind].sheet for rig in rigs] for kind in ("camera", "lidar"))
    rows = [lidar.rows for lidar in lidars]
    assert (min(rows), max(rows) >= 96) == (16, True)
    assert {camera.model for camera in cameras} == {"equidistant", "plumb_bob"}
    assert len({camera.width_px for camera in cameras}) > 10
    assert all(40 < camera.horizontal_deg <= 150 for camera in cameras)
    # No frame costs much more than another.
    assert all(280_000 < camera.width_px * camera.height_px < 540_000 for camera in cameras)
    assert all(lidar.rows * lidar.columns < 80_000 for lidar in lidars)


@pytest.mark.parametrize(
    ("name", "sensor", "axis", "ahead"),
    [
        ("corner-left", "radar", 0, [np.sqrt(0.5), np.sqrt(0.5), 0]),
        ("corner-right", "radar", 0, [np.sqrt(0.5), -np.sqrt(0.5), 0]),
        ("tilted", "lidar", 0, [np.cos(np.radians(5)), 0, -np.sin(np.radians(5))]),
        ("truck", "camera", 2, [np.cos(np.radians(6)), 0, -np.sin(np.radians(6))]),  # the optical axis is z
    ],
)
def test_a_sensor_looks_to_the_left_by_a_positive_yaw_and_down_by_a_positive_pitch(name, sensor, axis, ahead):
    T = mounting_of(rig_named(name), 1, 0, 0)[sensor].T_vehicle_nominal
    np.testing.assert_allclose(T[:3, axis], ahead, atol=1e-9)


def nearest_deg(spec, first_s, second_s):
    """Angle from each beam of the second sweep to the nearest of the first."""
    first, second = (np.degrees(beams_of(spec, t)) for t in (first_s, second_s))
    return cKDTree(first).query(second)[0]


def test_a_rosette_does_not_repeat_itself_and_a_scanner_does():
    rosette, rows = rig_named("rosette")["lidar"].sheet, rig_named("demo")["lidar"].sheet
    assert nearest_deg(rows, 1.0, 1.1).max() == 0
    # As far apart as two random draws of as many beams: half the mean spacing (82 x 25 deg, 24,000 beams).
    assert np.median(nearest_deg(rosette, 1.0, 1.1)) > 0.05
    for sweeps in range(2, 40):
        assert np.mean(nearest_deg(rosette, 1.0, 1.0 + 0.1 * sweeps) < 1e-3) < 0.02


def moving_camera(rig="demo", environment="highway", t=2.0):
    """A moment of a drive, the rig's mounting, and the vehicle's motion."""
    drive = Drive(5, environment, 8.0, 0)
    return World(drive).moment(t), mounting_of(rig_named(rig), 3, 0, 0), drive


def shown_at(moment, mounting, drive, delay_s):
    """What a camera that exposes all rows at once sees a little later."""
    T = drive.ego.poses(np.array([moment.t_s + delay_s]))[0] @ mounting["camera"].T_vehicle
    return view_of(moment.advanced(moment.t_s + delay_s), mounting["camera"].camera, T).coarse


def test_each_row_of_a_rolling_shutter_sees_the_world_of_its_own_time():
    moment, mounting, drive = moving_camera()
    shutter = RollingShutter(drive.ego, mounting["camera"].T_vehicle, 0.06)
    T = drive.ego.poses(np.array([moment.t_s]))[0] @ mounting["camera"].T_vehicle
    rolled = view_of(moment, mounting["camera"].camera, T, shutter).coarse
    rows = len(rolled)
    delays = shutter.delays_s(rows)
    assert delays[0] == pytest.approx(-0.03, abs=2e-4)
    assert delays[-1] == pytest.approx(0.03, abs=2e-4)
    middle = shown_at(moment, mounting, drive, 0.0)
    own, at_once = [], []
    for row in (rows // 2, int(0.65 * rows), int(0.85 * rows)):
        own.append(np.mean(rolled[row] != shown_at(moment, mounting, drive, delays[row])[row]))
        at_once.append(np.mean(rolled[row] != middle[row]))
    assert max(own) < 0.004
    assert max(at_once) > 0.02


def test_a_mixed_day_drives_through_town_and_on_highways():
    spec = FleetSpec(vehicles=1, days=1, environments="mixed")
    assert [drive_of(spec, 0, 0, i, 10).environment for i in range(3)] == ["urban", "highway", "urban"]

"""Radar messages of three kinds become points with range rates that grow when things recede."""

import numpy as np
import pytest

from pipeline.core.rigs import RadarTopics
from pipeline.ingest.messages.radar import read_radar


def config(**fields):
    return RadarTopics(points="/radar", **fields)


@pytest.mark.parametrize(("positive", "sign"), [("receding", 1), ("approaching", -1)])
def test_range_rate_is_positive_for_receding_whatever_the_sign_in_the_log(kit, positive, sign):
    message = kit.Kit().cloud(0, kit.radar(0))
    found = read_radar(message, "sensor_msgs/msg/PointCloud2", config(doppler_positive=positive))
    np.testing.assert_array_equal(found.range_rate_mps, sign * kit.radar(0)["doppler"])


@pytest.mark.parametrize(
    ("fields", "named"),
    [({"doppler_field": "velocity"}, "'velocity'"), ({"velocity_fields": ("vx", "vy")}, "'vx', 'vy'")],
)
def test_fields_that_are_not_there_are_named_with_those_that_are(kit, fields, named):
    message = kit.Kit().cloud(0, kit.radar(0))
    with pytest.raises(ValueError, match=rf"{named}.*x, y, z, doppler, power"):
        read_radar(message, "PointCloud2", config(**fields))


def test_a_planar_radar_is_flagged(kit):
    columns = kit.radar(0)
    with_elevation = read_radar(kit.Kit().cloud(0, columns), "PointCloud2", config())
    del columns["z"]
    planar = read_radar(kit.Kit().cloud(0, columns), "PointCloud2", config())
    assert with_elevation.has_elevation
    assert not planar.has_elevation
    assert not planar.xyz_m[:, 2].any()


def test_radar_points_that_are_not_finite_are_dropped_and_counted(kit):
    columns = kit.radar(0)
    columns["doppler"][0], columns["x"][1] = np.nan, np.inf
    for name in "xyz":
        columns[name][2] = 0
    columns["y"][3] = 4e6
    cloud = read_radar(kit.Kit().cloud(0, columns), "PointCloud2", config())
    dropped = {"not_finite": 2, "at_no_range": 1, "beyond_range": 1}
    assert dict(cloud.dropped) == {f"radar_points_{why}": n for why, n in dropped.items()}
    np.testing.assert_array_equal(cloud.power_db, columns["power"][4:])


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("azimuth_positive", ["left", "right"])
def test_radar_scans_are_read_by_their_angles(kit, tmp_path, run_ingest, ros, azimuth_positive):
    drive = kit.Kit(ros=ros).drive()
    azimuth, elevation, distance = np.array([0.5, -0.2]), np.array([0.1, -0.05]), np.array([20.0, 50.0])
    kind = "radar_msgs/msg/RadarReturn"
    returns = [
        drive.new(kind, range=r, azimuth=a, elevation=e, doppler_velocity=-5.0, amplitude=12.0)
        for r, a, e in zip(distance, azimuth, elevation, strict=True)
    ]
    kind = "radar_msgs/msg/RadarScan"
    drive.each(kit.RADAR, lambda _, at: drive.new(kind, header=drive.header(at, "radar"), returns=returns))
    log = drive.bag(tmp_path / "a.bag") if ros == 1 else drive.mcap(tmp_path / "a.mcap")
    fleet = kit.fleet(radar={"azimuth_positive": azimuth_positive, "doppler_positive": "receding"})
    _, frames = run_ingest(log, fleet=fleet)
    assert len(frames) == 4
    sign = 1 if azimuth_positive == "left" else -1
    xyz = frames[0].radar_xyz_m.astype(float)
    np.testing.assert_allclose(np.arctan2(xyz[:, 1], xyz[:, 0]), sign * azimuth, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(xyz, axis=1), distance, rtol=1e-6)
    np.testing.assert_allclose(np.arcsin(xyz[:, 2] / distance), elevation, atol=1e-6)
    np.testing.assert_array_equal(frames[0].radar_range_rate_mps, [-5.0, -5.0])
    np.testing.assert_array_equal(frames[0].radar_power_db, [12.0, 12.0])


@pytest.mark.parametrize("old_types", [False, True])
def test_radar_tracks_are_read_by_the_definition_in_the_log_whichever_version_it_is(
    kit, tmp_path, run_ingest, old_types
):
    drive = kit.Kit(old_types=old_types).drive()
    zero = drive.vector("Vector3", 0, 0, 0)
    rest = {"track_id": 7, "classification": "car", "acceleration": zero, "size": zero}
    if not old_types:
        del rest["track_id"]
        uuid = drive.new("unique_identifier_msgs/msg/UUID", uuid=np.arange(16, dtype=np.uint8))
        rest |= {"uuid": uuid, "classification": 32001}
    at, velocity = drive.vector("Point", 30, 40, 0), drive.vector("Vector3", 3, 4, 0)
    track = drive.new("radar_msgs/msg/RadarTrack", position=at, velocity=velocity, **rest)
    kind = "radar_msgs/msg/RadarTracks"
    drive.each(kit.RADAR, lambda _, at: drive.new(kind, header=drive.header(at, "radar"), tracks=[track]))
    _, frames = run_ingest(drive.mcap(tmp_path / "a.mcap"))
    np.testing.assert_array_equal(frames[2].radar_xyz_m, [[30, 40, 0]])
    np.testing.assert_allclose(frames[2].radar_range_rate_mps, [5.0])  # along the line of sight, moving away


def test_velocity_components_give_the_range_rate_that_doppler_gives(kit):
    columns = kit.radar(0)
    xyz = np.stack([columns[n] for n in "xyz"], axis=1).astype(float)
    velocity = np.random.default_rng(1).normal(0, 10, (len(xyz), 3))
    along = np.sum(xyz * velocity, axis=1) / np.linalg.norm(xyz, axis=1)
    del columns["doppler"]
    columns |= {f"v{n}": velocity[:, i].astype(np.float32) for i, n in enumerate("xyz")}
    found = read_radar(kit.Kit().cloud(0, columns), "PointCloud2", config(velocity_fields=("vx", "vy", "vz")))
    np.testing.assert_allclose(found.range_rate_mps, along, atol=1e-5)
    columns["z"][:] = 0  # a planar radar: two components say all
    found = read_radar(kit.Kit().cloud(0, columns), "PointCloud2", config(velocity_fields=("vx", "vy")))
    expected = np.sum(xyz[:, :2] * velocity[:, :2], axis=1) / np.hypot(xyz[:, 0], xyz[:, 1])
    np.testing.assert_allclose(found.range_rate_mps, expected, atol=1e-5)


def test_doppler_and_velocity_components_cannot_both_be_named():
    with pytest.raises(ValueError, match="velocity_fields replaces doppler_field"):
        config(velocity_fields=("vx", "vy"), doppler_field="v")

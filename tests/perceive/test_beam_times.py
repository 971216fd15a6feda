"""Times of a spinning lidar's points from their azimuth: its sense, where a turn begins, and when to be silent."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from mcap.reader import make_reader

from pipeline.ingest.deskew import deskew
from pipeline.perceive.beam_times import BeamTimes, beam_times
from pipeline.perceive.sweep_pairs import surfaces_of
from pipeline.perceive.untimed_sweeps import BY_AZIMUTH, WITHOUT_TIMES, Turning, turning_of
from pipeline.rig.topics import TOPICS
from pipeline.rigs import LidarTurn
from pipeline.ros_messages import RosMessages
from pipeline.simulate.sensors.lidar import sweep_lidar
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive
from schemas.captures import Sweep
from tests.makers.swept_streets import AROUND, pose

GAP_S, SWEEPS, LEFT, RIGHT = 0.5, 14, 1.0, -1.0
MOUNTED = pose(1.2, 0.0, 1.9)


@dataclass
class Seen:
    """A moment, as far as this is concerned."""

    moment: int
    stamp_ns: int
    drive: int = 0
    ego_speed_mps: float | None = None
    ego_yaw_rate_radps: float | None = None


@cache
def drive():
    """Sweeps as they were measured, and as they would look from where the car was in the middle of each."""
    rng, out = np.random.default_rng(33), []
    street = Drive(33, "urban", 3.0 + SWEEPS * GAP_S, 0)
    world = World(street)
    for k in range(SWEEPS):
        middle_s = 1.0 + k * GAP_S
        raw = sweep_lidar(
            world.moment(middle_s), street.ego, MOUNTED, AROUND, middle_s + AROUND.sweep_s / 2, rng
        )
        since_s = raw.time_s + np.float32(AROUND.sweep_s / 2)
        T = street.ego.poses(np.array([middle_s]))[0]
        velocity, omega = (v[0] for v in street.ego.velocities(np.array([middle_s])))
        still = deskew(raw.xyz_m, since_s, float(velocity @ T[:3, 0]), float(omega @ T[:3, 2]), MOUNTED)
        out.append((raw.xyz_m, still, since_s))
    return out


def found_of(clouds, gap_s=GAP_S):
    surfaces = {k: surfaces_of(xyz) for k, xyz in enumerate(clouds)}
    return beam_times(surfaces, [(k, k + 1, gap_s) for k in range(len(clouds) - 1)], {})


def mirrored(xyz):
    return (xyz * [1, -1, 1]).astype(np.float32)


def sweep(xyz):
    x, y, z = xyz.astype(np.float32).T
    return Sweep(
        moment=0, stamp_ns=0, lidar_x_m=x, lidar_y_m=y, lidar_z_m=z, lidar_intensity=None, lidar_ring=None,
        lidar_time_s=None, lidar_deskewed=False,
    )  # fmt: skip


def off_m(cloud, still):
    return float(np.median(np.linalg.norm(cloud - still, axis=1)))


@pytest.mark.slow
@pytest.mark.parametrize(("change", "sense"), [(np.asarray, RIGHT), (mirrored, LEFT)])
def test_a_moving_car_shows_which_way_its_lidar_turns_and_where_a_turn_begins(change, sense):
    raw, still, since_s = zip(*drive(), strict=True)
    found = found_of([change(xyz) for xyz in raw])
    assert found.turn is not None
    assert found.turn.sense == sense
    assert abs(np.cos(found.turn.begin_rad) + 1) < 0.07  # behind the car, within 20 deg
    turning = Turning(found.turn, found.motion)
    wrong = Turning(replace(found.turn, sense=-sense), found.motion)
    for k in range(0, SWEEPS, 6):
        as_logged, right = change(raw[k]), change(still[k])
        by_azimuth, note = turning.timed(Seen(k, 0), sweep(as_logged))
        assert (note, by_azimuth.lidar_deskewed) == (BY_AZIMUTH, True)
        ahead = np.abs(np.arctan2(as_logged[:, 1], as_logged[:, 0])) < 2.5  # the begin is known to a sector
        assert np.abs(by_azimuth.lidar_time_s - since_s[k])[ahead].max() < 0.008
        as_far = off_m(as_logged, right)
        assert off_m(by_azimuth.lidar_xyz_m, right) < 0.3 * as_far
        assert off_m(wrong.timed(Seen(k, 0), sweep(as_logged))[0].lidar_xyz_m, right) > 1.5 * as_far


@pytest.mark.slow
def test_sweeps_that_their_driver_has_put_right_are_left_as_they_are():
    assert found_of([still for _, still, _ in drive()]).turn is None


def test_a_car_that_stands_tells_nothing_and_its_points_stay():
    rng, (_, still, _) = np.random.default_rng(0), drive()[0]
    clouds = [(still + rng.normal(0, 0.01, still.shape)).astype(np.float32) for _ in range(10)]
    found = found_of(clouds)
    assert found.turn is None
    stands = Seen(0, 0, ego_speed_mps=0.0)
    assert Turning(None, found.motion).timed(stands, sweep(clouds[0]))[1] == ""
    timed, _ = Turning(BeamTimes(LEFT, 0.0), found.motion).timed(stands, sweep(clouds[0]))
    np.testing.assert_array_equal(timed.lidar_xyz_m, clouds[0])


def test_a_car_that_drives_and_a_lidar_of_which_nobody_knows_is_counted():
    as_logged = sweep(drive()[0][0])
    after, note = Turning(None, {}).timed(Seen(0, 0, ego_speed_mps=8.0), as_logged)
    assert after is as_logged
    assert note == WITHOUT_TIMES


@pytest.mark.parametrize(
    ("sense", "stamp", "times"), [("left", "begin", (0.0, 0.025)), ("right", "end", (-0.1, -0.025))]
)
def test_what_fleet_toml_says_needs_no_car_that_moves(sense, stamp, times):
    told = LidarTurn(sense=sense, begins_deg=-90.0, stamp=stamp)
    moments = [(Seen(0, 0), sweep(drive()[0][0]))]
    turn = turning_of(moments, told).turn
    at = turn.at(np.radians([-89.9999, 0.0]) if sense == "left" else np.radians([-90.0001, 0.0]))
    np.testing.assert_allclose(at, times, atol=1e-4)


@pytest.mark.parametrize("change", [{"lidar_time_s": "some"}, {"lidar_deskewed": True}, {"only": "ahead"}])
def test_sweeps_with_times_and_lidars_that_do_not_spin_are_not_looked_at(change):
    xyz = drive()[0][0]
    if "only" in change:
        xyz, change = xyz[xyz[:, 0] > 0], {}
    if "lidar_time_s" in change:
        change = {"lidar_time_s": np.zeros(len(xyz), np.float32)}
    assert turning_of([(Seen(0, 0), replace(sweep(xyz), **change))], None) is None


@pytest.mark.slow
@pytest.mark.real_logs
def test_kitti_s_lidar_turns_to_the_right_and_begins_behind(kitti_logs):
    """As the odometry programs that are measured on it assume, whose authors know the sensor."""
    store, clouds = RosMessages(2).typestore, []
    (log,) = kitti_logs.glob("*.mcap")
    with log.open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages(topics=[TOPICS["lidar"]]):
            held = store.deserialize_cdr(message.data, schema.name)
            clouds.append(np.frombuffer(held.data.tobytes(), "<f4").reshape(-1, held.point_step // 4)[:, :3])
    found = found_of(clouds, 0.3)
    assert found.turn is not None
    assert found.turn.sense == RIGHT
    assert abs(np.cos(found.turn.begin_rad) + 1) < 0.07
    assert found.motion[0].x == pytest.approx(2.4, abs=0.2)
    assert found.motion[len(clouds) - 1].way < 0.1

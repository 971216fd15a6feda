"""Times of a spinning lidar's points from their azimuth, as fleet.toml says that it turns."""

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest

from pipeline.core.rigs import LidarTurn
from pipeline.ingest.captures import deskew
from pipeline.perceive.untimed_sweeps import BY_AZIMUTH, WITHOUT_TIMES, Turning, turning_of
from pipeline.simulate.sensors.lidar import sweep_lidar
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive
from schemas.captures import Sweep
from schemas.moments import EgoColumns, Moment
from tests.makers.swept_streets import AROUND, pose

GAP_S, SWEEPS = 0.5, 14


MOUNTED = pose(1.2, 0.0, 1.9)
_AZIMUTH = np.linspace(-np.pi, np.pi, 20_000)
ANY = np.stack([9 * np.cos(_AZIMUTH), 9 * np.sin(_AZIMUTH), np.tile([-1.0, 0.0, 1.0, 2.0], 5_000)], 1)


def seen_at(stamp_s, speed_mps=None):
    """A moment of the one drive; moments are told apart by their numbers."""
    ego = dict.fromkeys(f.name for f in fields(EgoColumns)) | {"ego_speed_mps": speed_mps}
    number, stamp_ns = round(10 * stamp_s), round(1e9 * stamp_s)
    return Moment(moment=number, log="", drive=0, stamp_ns=stamp_ns, rows={}, gap_ns={}, **ego)


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
@pytest.mark.parametrize(("change", "sense"), [(np.asarray, "right"), (mirrored, "left")])
def test_points_are_moved_to_the_stamp_by_the_motion_between_sweeps(change, sense):
    raw, still, since_s = zip(*drive(), strict=True)
    seen = [(seen_at(k * GAP_S), sweep(change(xyz))) for k, xyz in enumerate(raw)]
    turning = turning_of(seen, LidarTurn(sense=sense, begins_deg=180.0))
    wrong = replace(
        turning, turn=LidarTurn(sense={"left": "right", "right": "left"}[sense], begins_deg=180.0)
    )
    for k in range(0, SWEEPS, 6):
        as_logged, right = change(raw[k]), change(still[k])
        by_azimuth, note = turning.timed(*seen[k])
        assert (note, by_azimuth.lidar_deskewed) == (BY_AZIMUTH, True)
        ahead = np.abs(np.arctan2(as_logged[:, 1], as_logged[:, 0])) < 2.5
        assert np.abs(by_azimuth.lidar_time_s - since_s[k])[ahead].max() < 0.008
        as_far = off_m(as_logged, right)
        assert off_m(by_azimuth.lidar_xyz_m, right) < 0.3 * as_far
        assert off_m(wrong.timed(*seen[k])[0].lidar_xyz_m, right) > 1.5 * as_far


@pytest.mark.parametrize(("speed_mps", "note"), [(0.0, ""), (8.0, WITHOUT_TIMES)])
def test_a_lidar_of_which_nobody_knows_is_counted_where_the_car_drives(speed_mps, note):
    as_logged = sweep(ANY)
    assert Turning(None, {}).timed(seen_at(0.0, speed_mps), as_logged) == (as_logged, note)


@pytest.mark.parametrize(
    ("sense", "stamp", "times"), [("left", "begin", (0.0, 0.025)), ("right", "end", (-0.1, -0.025))]
)
def test_what_fleet_toml_says_needs_no_car_that_moves(sense, stamp, times):
    told = LidarTurn(sense=sense, begins_deg=-90.0, stamp=stamp)
    azimuth = np.radians([-89.9999, 0.0] if sense == "left" else [-90.0001, 0.0])
    ahead = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1)
    cloud = sweep(np.vstack([10 * ahead, ANY]))
    timed, note = turning_of([(seen_at(0.0), cloud)], told).timed(seen_at(0.0), cloud)
    np.testing.assert_allclose(timed.lidar_time_s[:2], times, atol=1e-4)
    assert (note, timed.lidar_deskewed) == (BY_AZIMUTH, False)

"""A radar's yaw, pitch and clock against the base, by Doppler and the way; nothing where the day is silent."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.edges.lidar_base import STANCE
from pipeline.calibrate.edges.radar_base import Stamps, estimate_radar_base
from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.calibrate.verify.day_checks import MOVED_SIGMAS, PART_FLOOR_RAD
from pipeline.objective.ego_motion import DopplerMotion, EgoMotion
from pipeline.objective.radar.travel import TravelDirections
from pipeline.rig.graph import BASE, Edge, Sensor
from pipeline.rig.se3 import (
    adjoint,
    change_between,
    change_jacobian,
    exp_so3,
    from_rotation_translation,
    inverse,
)

EDGE = Edge(Sensor("corner", "radar"), BASE)
F, STEP_S, GAP_S, LATE_S, NOISE_MPS = 160, 0.5, 0.02, -0.018, 0.05
ALL = Scenes(np.arange(F), np.arange(F) // 8)
STAMPS = Stamps(
    (np.arange(F) * STEP_S * 1e9).astype(np.int64), ((np.arange(F) * STEP_S + GAP_S) * 1e9).astype(np.int64),
    np.arange(F) // 80,
)  # fmt: skip


def mounted(yaw_deg, pitch_deg=0.0, x=3.6, y=0.7):
    R = exp_so3(np.radians([0.0, 0.0, yaw_deg])) @ exp_so3(np.radians([0.0, pitch_deg, 0.0]))
    return from_rotation_translation(R, np.array([x, y, 0.6]))


def speed_at(t, changes=5.0):
    return 14 + changes * np.sin(t / 4)


def day(T, seed=1, off_deg=2.0, changes=5.0, still=False):
    """A radar's scans along a bending street, and the car's motion by odometry."""
    rng = np.random.default_rng(seed)
    t = np.arange(F) * STEP_S
    turn = 0.2 * np.sin(t / 6) * (not still)
    speed = np.zeros(F) if still else speed_at(t, changes)
    # The scan's stamp is LATE_S more than the base's clock says.
    at_scan = 0 * speed if still else speed_at(t + GAP_S - LATE_S, changes)
    own = np.stack([at_scan - turn * T[1, 3], turn * T[0, 3], 0 * turn], 1) @ T[:3, :3]
    own += rng.normal(0, NOISE_MPS, (F, 3))
    prior = from_rotation_translation(exp_so3(np.radians([0.0, 0.0, off_deg])) @ T[:3, :3], T[:3, 3])
    radar = DopplerMotion("corner", own, np.tile(np.eye(3) * NOISE_MPS**2, (F, 1, 1)), prior, np.radians(2.0))
    motion = np.stack([speed + rng.normal(0, 0.03, F), 0 * speed], 1)
    ego = EgoMotion(
        motion, turn + rng.normal(0, 0.002, F), np.tile(np.diag([0.03, 0.05, 0.002]) ** 2, (F, 1, 1))
    )
    return radar, ego


def by_axis(evidence):
    """T_base_radar, and sigmas of pitch, yaw and clock."""
    T = inverse(evidence.T)
    B = np.eye(7)
    B[:6, :6] = -np.linalg.inv(adjoint(T)) @ np.linalg.inv(change_jacobian(T))
    information = np.diag(B.T @ evidence.information @ B)[[1, 2, 6]]
    return T, np.where(information > 1e-6 * information.max(), np.abs(information) + 1e-12, 1e-12) ** -0.5


@pytest.mark.parametrize(("yaw_deg", "seed"), [(0.0, 1), (60.0, 2), (-140.0, 3), (180.0, 1)])
def test_yaw_and_clock_come_out_within_sigma_wherever_the_radar_looks(yaw_deg, seed):
    T_true = mounted(yaw_deg)
    radar, ego = day(T_true, seed)
    late = replace(ego, velocity_mps=ego.velocity_mps.copy())  # by other radars, with clocks of their own
    late.velocity_mps[:, 0] += speed_at(STAMPS.moment_ns * 1e-9 + 0.03) - speed_at(STAMPS.moment_ns * 1e-9)
    evidence = estimate_radar_base(EDGE, radar, late, STAMPS, ALL, timed_mps=ego.velocity_mps[:, 0])
    T, sigma = by_axis(evidence)
    error = change_between(T, T_true)[2]
    assert abs(error) < min(4 * sigma[1], np.radians(0.1))
    assert abs(evidence.dt_s - LATE_S) < min(4 * sigma[2], 0.015)
    assert sigma[2] < 0.02 < by_axis(estimate_radar_base(EDGE, radar, late, STAMPS, ALL))[1][2]
    assert any("pitch" in note for note in evidence.notes)
    assert sigma[0] > 1e3
    # Roll and position have no information.
    assert np.linalg.matrix_rank(evidence.information, tol=1e-9 * evidence.information.max()) == 2


def test_a_wrong_lever_arm_is_no_yaw():
    radar, ego = day(mounted(60.0))
    moved = radar.T_base_radar.copy()
    moved[0, 3] -= 0.5
    evidence = estimate_radar_base(EDGE, replace(radar, T_base_radar=moved), ego, STAMPS, ALL)
    assert abs(change_between(inverse(evidence.T), mounted(60.0))[2]) < np.radians(0.1)
    assert evidence.diagnostics["lever_less_prior_m"] == pytest.approx(0.5, abs=0.15)


def test_an_even_speed_shows_no_clock_and_a_standing_car_nothing():
    radar, ego = day(mounted(0.0), changes=0.0)
    ego = EgoMotion(ego.velocity_mps * 0 + [14.0, 0.0], ego.yaw_rate_radps, ego.covariance)
    even = estimate_radar_base(EDGE, radar, ego, STAMPS, ALL)
    assert even.information[6, 6] < 10
    assert any("clock" in note for note in even.notes)
    radar, ego = day(mounted(0.0), still=True)
    standing = estimate_radar_base(EDGE, radar, ego, STAMPS, ALL)
    assert not standing.information.any()
    assert len(standing.notes) == 4


def test_convoys_in_some_scans_do_not_turn_the_radar():
    radar, ego = day(mounted(0.0))
    radar.velocity_mps[::9] += [9.0, 2.0, 0.0]
    evidence = estimate_radar_base(EDGE, radar, ego, STAMPS, ALL)
    assert abs(change_between(inverse(evidence.T), mounted(0.0))[2]) < np.radians(0.1)


def test_a_radar_that_turned_at_noon_shows_it_with_time_and_size():
    radar, ego = day(mounted(60.0))
    steady = estimate_radar_base(EDGE, radar, ego, STAMPS, ALL)
    assert np.abs(steady.parts.sigmas(PART_FLOOR_RAD)).max() < 3.0
    later = np.arange(F) >= 100
    radar.velocity_mps[later] @= exp_so3(np.radians([0.0, 0.0, 1.0]))
    found = estimate_radar_base(EDGE, radar, ego, STAMPS, ALL).parts
    assert found.tested == (2,)
    assert abs(found.sigmas(PART_FLOOR_RAD)[2]) > 2 * MOVED_SIGMAS
    assert np.degrees(abs(found.step[2])) == pytest.approx(1.0, abs=0.15)
    assert abs(found.cut_ns[1] - STAMPS.moment_ns[100]) <= 10 * STEP_S * 1e9


def test_halves_of_the_scenes_that_differ_show_by_how_much():
    radar, ego = day(mounted(0.0))
    agreed = estimate_radar_base(EDGE, radar, ego, STAMPS, ALL).others
    assert abs(agreed.shift[2]) < 3 * np.sqrt(agreed.covariance[2, 2])
    way_m = np.cumsum(np.r_[0.0, ego.velocity_mps[1:, 0] * STEP_S])
    odd = (way_m // 50.0) % 2 == 1
    radar.velocity_mps[odd] @= exp_so3(np.radians([0.0, 0.0, 2.0]))
    found = estimate_radar_base(EDGE, radar, ego, STAMPS, ALL).others
    assert np.degrees(abs(found.shift[2])) == pytest.approx(1.0, abs=0.2)
    assert not np.any(found.shift[[0, 1]])
    assert found.covariance[2, 2] >= STANCE[2] ** 2


def test_velocities_with_a_lidars_elevations_show_pitch():
    T_true = mounted(0.0, pitch_deg=1.5)
    radar, ego = day(T_true, off_deg=1.0)
    v = radar.velocity_mps + np.random.default_rng(2).normal(0, [0, 0, 0.1], (F, 3))
    told = TravelDirections(v, np.full(F, 0.01), *np.zeros((4, F)), np.arange(F))
    level = replace(radar, T_base_radar=mounted(1.0))
    evidence = estimate_radar_base(EDGE, level, ego, STAMPS, ALL, told)
    T, sigma = by_axis(evidence)
    assert abs(change_between(T, T_true)[1]) < 4 * sigma[0] < np.radians(0.5)

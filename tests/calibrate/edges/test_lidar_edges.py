"""A lidar over the base by the road and the way, and two lidars of one car: within sigma, and nothing made up."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.edges.lidar_base import _rows, estimate_lidar_base, road_under
from pipeline.calibrate.edges.lidar_lidar import LidarPair, estimate_lidar_lidar
from pipeline.calibrate.edges.on_base import regress
from pipeline.calibrate.edges.sweep_travel import SweepTravel
from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.calibrate.verify.day_checks import MOVED_SIGMAS, PART_FLOOR_RAD
from pipeline.calibrate.verify.held_out import paired_test
from pipeline.core.errors import SolveError
from pipeline.objective.ego_motion import EgoMotion
from pipeline.rig.graph import BASE, Edge, Sensor
from pipeline.rig.se3 import (
    adjoint,
    change_between,
    change_jacobian,
    exp_se3,
    exp_so3,
    inverse,
    perturb_exactly,
)
from pipeline.simulate.sensors.rig_spec import LidarSpec
from tests.makers.swept_streets import AROUND, FORWARD, Mounted, chosen, pose, swept_streets

EDGE = Edge(Sensor("top", "lidar"), BASE)
AXES = [0, 1, 2, 5]  # of a change of T_base_lidar: roll, pitch, yaw, height
LIMITS = np.array([*np.radians([0.1, 0.1, 0.1]), 0.02])
T_BASE_TOP = pose(1.5, 0.1, 1.8, yaw_deg=1.0, pitch_deg=2.0)


@pytest.fixture(scope="module")
def street():
    return swept_streets({"top": Mounted(T_BASE_TOP)}, seed=31, moments=36, rate_hz=1.0)


@pytest.fixture(scope="module")
def evidence(street):
    return estimated(street)


def estimated(street, start=None, **given):
    nominal = street.nominal["top"]
    return estimate_lidar_base(
        EDGE, street.sweeps["top"], street.ego, nominal if start is None else start, street.scenes,
        T_base_lidar_deskewed=nominal, **given,
    )  # fmt: skip


def by_axis(evidence):
    """T_base_lidar at the minimum by roll, pitch, yaw, height, and their sigmas; infinite of what is not shown."""
    T = inverse(evidence.T)
    to_left = -np.linalg.inv(adjoint(T)) @ np.linalg.inv(change_jacobian(T))
    information = (to_left.T @ evidence.information[:6, :6] @ to_left)[np.ix_(AXES, AXES)]
    shown = np.diag(information) > 1e-6 * np.diag(information).max()
    return T, np.where(shown, np.abs(np.diag(information)) ** -0.5, np.inf)


def errors(evidence, T_base_lidar):
    T, sigma = by_axis(evidence)
    return change_between(T, T_base_lidar)[AXES], sigma


def assert_right(evidence):
    error, sigma = errors(evidence, T_BASE_TOP)
    assert (np.abs(error) < LIMITS).all(), error
    assert (np.abs(error) < 4 * sigma + [1e-4, 1e-4, 1e-4, 1e-3]).all(), error / sigma
    assert (sigma < LIMITS).all(), sigma
    assert not evidence.checks


def test_a_pose_of_known_truth_comes_out_within_its_sigma(evidence):
    assert_right(evidence)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "kind", "spec"), [(33, "highway", FORWARD), (34, "urban", AROUND)])
def test_a_pose_of_known_truth_comes_out_on_a_highway_and_by_a_lidar_that_looks_around(seed, kind, spec):
    street = swept_streets(
        {"top": Mounted(T_BASE_TOP, spec)}, seed=seed, moments=36, environment=kind, rate_hz=1.0
    )
    assert_right(estimated(street))


@pytest.mark.slow
def test_a_start_five_degrees_off_leads_to_the_same_pose(street, evidence):
    far = perturb_exactly(street.nominal["top"], np.radians(5.0), 0.1, np.random.default_rng(3))
    T, sigma = by_axis(evidence)
    again, _ = by_axis(estimated(street, far))
    assert (np.abs(change_between(T, again)[AXES]) < np.maximum(sigma, [3e-4, 3e-4, 3e-4, 1e-3])).all()


def test_x_and_y_have_no_information_and_the_clock_none(evidence):
    information = evidence.information
    assert np.linalg.matrix_rank(information, tol=1e-6 * information.max()) == 4
    assert not information[6].any()
    # A shift of the lidar along the base's x or y costs nothing: T_lidar_base moves by R_lidar_base of it.
    R = evidence.T[:3, :3]
    for axis in (0, 1):
        along = np.r_[np.zeros(3), R[:, axis], 0.0]
        assert along @ information @ along == pytest.approx(0.0, abs=1e-6 * information.max())


def test_the_information_is_of_left_perturbations(evidence):
    T, sigma = by_axis(evidence)
    xi = np.array([2e-4, -3e-4, 1e-4, 2e-4, 1e-4, -3e-4])
    change = change_between(T, inverse(exp_se3(xi) @ evidence.T))[AXES]
    cost = np.sum((change / sigma) ** 2)
    assert xi @ evidence.information[:6, :6] @ xi == pytest.approx(cost, rel=0.01)


def test_an_empty_square_shows_no_yaw_and_still_the_road(street):
    flat = [chosen(s, s.is_ground) for s in street.sweeps["top"]]
    evidence = estimated(replace(street, sweeps={"top": flat}))
    error, sigma = errors(evidence, T_BASE_TOP)
    assert not np.isfinite(sigma[2])
    assert any("yaw" in note for note in evidence.notes)
    assert (np.abs(error[[0, 1, 3]]) < LIMITS[[0, 1, 3]]).all()


def test_without_motion_only_the_road_speaks(street):
    unknown = EgoMotion(
        street.ego.velocity_mps * np.nan, street.ego.yaw_rate_radps * np.nan, street.ego.covariance
    )
    _, sigma = errors(estimated(replace(street, ego=unknown)), T_BASE_TOP)
    assert not np.isfinite(sigma[2])
    assert np.isfinite(sigma[[0, 1, 3]]).all()


def test_a_car_that_nods_when_it_brakes_keeps_its_pitch(street):
    sweeps, speed = street.sweeps["top"], street.ego.velocity_mps[:, 0]
    stamps = np.array([s.stamp_ns for s in sweeps]) * 1e-9
    faster = np.gradient(speed, stamps)
    nodding = [turned(s, [0.0, np.radians(-0.2) * a, 0.0]) for s, a in zip(sweeps, faster, strict=True)]
    assert np.abs(faster).max() > 1.0
    error, _ = errors(estimated(replace(street, sweeps={"top": nodding})), T_BASE_TOP)
    assert abs(error[1]) < LIMITS[1]


def test_a_lidar_that_turned_at_noon_shows_it(street, evidence):
    assert np.abs(evidence.parts.sigmas(PART_FLOOR_RAD)).max() < 3.0
    sweeps, noon = street.sweeps["top"], len(street.sweeps["top"]) // 2
    later = [turned(s, [0.0, 0.0, np.radians(1.0)]) for s in sweeps[noon:]]
    found = estimated(replace(street, sweeps={"top": [*sweeps[:noon], *later]})).parts
    assert np.abs(found.sigmas(PART_FLOOR_RAD)).max() > MOVED_SIGMAS
    assert np.degrees(abs(found.step[2])) == pytest.approx(1.0, abs=0.2)
    assert abs(found.cut_ns[1] - sweeps[noon].stamp_ns) < 4e9


def test_a_car_that_stands_otherwise_in_the_afternoon_is_no_lidar_that_moved(street):
    sweeps, noon = street.sweeps["top"], len(street.sweeps["top"]) // 2
    later = [turned(s, np.radians([0.3, 0.7, 0.0])) for s in sweeps[noon:]]
    found = estimated(replace(street, sweeps={"top": [*sweeps[:noon], *later]})).parts
    assert np.abs(found.sigmas(PART_FLOOR_RAD)).max() < 3.0


def test_cars_that_keep_their_distance_do_not_slow_the_way(street):
    box = np.random.default_rng(1).uniform([9.0, -1.0, -1.2], [9.3, 1.0, 0.2], (400, 3))
    beside = box + [2.0, 4.0, 0.0]
    convoy = [with_points(s, np.concatenate([box, beside])) for s in street.sweeps["top"]]
    error, _ = errors(estimated(replace(street, sweeps={"top": convoy})), T_BASE_TOP)
    assert (np.abs(error) < LIMITS).all()


def test_a_measured_height_is_one_more_measurement_and_is_checked(street, evidence):
    alone, _ = by_axis(evidence)
    height_m = float(T_BASE_TOP[2, 3])
    agreed = estimated(street, height_m=(height_m, 0.01))
    assert not agreed.checks
    wrong = estimated(street, height_m=(height_m + 0.2, 0.01))
    assert any("height" in c.sentence for c in wrong.checks)
    assert by_axis(agreed)[0][2, 3] == pytest.approx(alone[2, 3], abs=0.01)


def test_ways_of_motorways_that_lie_aside_do_not_outweigh_those_of_a_town():
    rng, town = np.random.default_rng(5), np.arange(60) >= 10  # 250 m of motorway, and as much in town
    way_m, none = np.where(town, 5.0, 25.0), np.zeros(60)
    sigma_rad = np.where(town, 0.005, 0.1) / way_m  # by registration
    azimuth_rad = np.where(town, rng.normal(0, np.radians(0.05), 60), sigma_rad)
    velocity_mps = way_m[:, None] * np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad), none], 1)
    turn_radps = np.outer(town * rng.uniform(-0.2, 0.2, 60), [0.0, 0.0, 1.0])
    sigmas_rad = np.stack([sigma_rad, sigma_rad], 1)
    travel = SweepTravel(np.arange(60), velocity_mps, turn_radps, way_m, none, sigmas_rad)
    ego = EgoMotion(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3, 3)))
    rows = _rows(travel, road_under([], np.eye(4), 0.0), ego, Scenes.of([]), 0.0)
    yaw = regress(rows["yaw"])
    assert abs(yaw.value[0]) < 3 * np.sqrt(yaw.covariance[0, 0]) < np.radians(0.1)


def with_points(sweep, xyz_m):
    """The sweep and points on something that stands on the ground, of a size that nobody knows."""
    nothing = np.zeros(len(xyz_m), bool)
    return replace(
        sweep, xyz_m=np.concatenate([sweep.xyz_m, xyz_m]), is_ground=np.r_[sweep.is_ground, nothing],
        may_move=np.r_[sweep.may_move, nothing], time_s=np.r_[sweep.time_s, 0.0 * nothing],
    )  # fmt: skip


def turned(sweep, rotation_base):
    """What the sweep would show of a body that is turned about the lidar by a rotation vector in the base."""
    R = T_BASE_TOP[:3, :3].T @ exp_so3(np.array(rotation_base)) @ T_BASE_TOP[:3, :3]
    return replace(sweep, xyz_m=sweep.xyz_m @ R)


PAIR = Edge(Sensor("top", "lidar"), Sensor("side", "lidar"))
SOLID = LidarSpec((-60.0, 60.0), (-12.5, 12.5), 300, 40, 0.1, 0.8, 100.0)
LATE_S, MOMENTS = 0.013, 16


def pair_of(spec, T_base_side, seed, kind="urban"):
    mounted = {
        "top": Mounted(pose(1.2, 0, 1.9), AROUND),
        "side": Mounted(T_base_side, spec, late_s=LATE_S, phase_s=0.03),
    }
    return swept_streets(mounted, seed=seed, moments=MOMENTS, environment=kind, rate_hz=1.0)


@pytest.fixture(scope="module")
def both():
    return pair_of(FORWARD, pose(3.6, 0.1, 0.7), 51)


def true_pose(T_base_side=None):
    return inverse(pose(1.2, 0, 1.9)) @ (pose(3.6, 0.1, 0.7) if T_base_side is None else T_base_side)


def given(both):
    deskewed = both.nominal["top"], both.nominal["side"]
    return LidarPair(both.sweeps["top"], both.sweeps["side"], pose(1.2, 0, 1.9), deskewed)


def pair_errors(evidence, T):
    J = np.eye(7)
    J[:6, :6] = change_jacobian(evidence.T)
    hardly = np.eye(7) * 1e-2  # 10 m, 10 rad: of what is not shown
    C = J @ np.linalg.inv(evidence.information + hardly) @ J.T
    C[:6, :6] += evidence.bias["edge"]
    return np.r_[change_between(evidence.T, T), -LATE_S - evidence.dt_s], np.sqrt(np.diag(C))


@pytest.mark.parametrize(
    ("seed", "spec", "T_base_side", "kind", "off_deg"),
    [
        (51, FORWARD, pose(3.6, 0.1, 0.7), "urban", 5.0),
        pytest.param(52, SOLID, pose(2.5, 0.9, 1.0, yaw_deg=60.0), "urban", 2.0, marks=pytest.mark.slow),
        pytest.param(53, FORWARD, pose(1.5, 0, 1.6, pitch_deg=4.0), "highway", 2.0, marks=pytest.mark.slow),
    ],
)
def test_pose_and_clock_of_known_truth_come_out_within_sigma(seed, spec, T_base_side, kind, off_deg):
    both, T = pair_of(spec, T_base_side, seed, kind), true_pose(T_base_side)
    start = perturb_exactly(T, np.radians(off_deg), 0.05, np.random.default_rng(seed))
    evidence = estimate_lidar_lidar(PAIR, given(both), both.ego, start, both.scenes)
    error, sigma = pair_errors(evidence, T)
    assert (np.abs(error[:3]) < np.radians(0.06)).all(), np.degrees(error[:3])
    assert (np.abs(error[4:6]) < 0.02).all(), error
    assert (np.abs(error) < 4 * sigma).all(), error / sigma
    assert (
        sigma[[3, 6]] < [0.05, 0.01]
    ).all() or kind == "highway"  # whose rails do not show the way along them
    assert not evidence.checks
    before, after, block = evidence.others.cost
    assert paired_test(before, after, block).z < -4.0  # of moments that took no part in the fit
    assert (np.abs(evidence.others.shift) < 4 * np.sqrt(np.diag(evidence.others.covariance))).all()
    assert np.abs(evidence.parts.sigmas(PART_FLOOR_RAD)).max() < 3.0


@pytest.mark.slow
def test_one_of_two_lidars_that_turned_at_noon_shows_it(both):
    R = exp_so3(np.radians([0.0, 0.0, 1.0]))
    later = [replace(s, xyz_m=s.xyz_m @ R) for s in both.sweeps["side"][MOMENTS // 2 :]]
    pair = replace(given(both), child=[*both.sweeps["side"][: MOMENTS // 2], *later])
    found = estimate_lidar_lidar(PAIR, pair, both.ego, true_pose(), both.scenes).parts
    assert abs(found.sigmas(PART_FLOOR_RAD)[2]) > MOVED_SIGMAS
    assert 0.5 < np.degrees(abs(found.step[2])) < 1.3


@pytest.mark.slow
def test_lidars_without_overlap_have_no_edge(both):
    back = [replace(s, xyz_m=s.xyz_m - [400.0, 0, 0]) for s in both.sweeps["side"]]
    with pytest.raises(SolveError, match="lie on surfaces of the other"):
        estimate_lidar_lidar(PAIR, replace(given(both), child=back), both.ego, true_pose(), both.scenes)

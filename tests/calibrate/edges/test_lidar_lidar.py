"""Two lidars of one car: pose and clock by what both see, within sigma; nothing where they share nothing."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.edges.lidar_lidar import LidarPair, _equations, _Moment, estimate_lidar_lidar
from pipeline.calibrate.verify.constancy import MOVED_SIGMAS, PART_FLOOR_RAD
from pipeline.calibrate.verify.held_out import paired_test
from pipeline.core.errors import SolveError
from pipeline.objective.sweep_registration import Surfaces
from pipeline.rig.changes import change_between, change_jacobian
from pipeline.rig.graph import Edge, Sensor
from pipeline.rig.se3 import exp_se3, exp_so3, inverse, perturb_exactly, transform_points
from pipeline.simulate.sensors.data_sheets import LidarSpec
from tests.makers.swept_streets import AROUND, FORWARD, Mounted, chosen, pose, swept_streets

EDGE = Edge(Sensor("top", "lidar"), Sensor("side", "lidar"))
SOLID = LidarSpec((-60.0, 60.0), (-12.5, 12.5), 300, 40, 0.1, 0.8, 100.0)
LATE_S, MOMENTS = 0.013, 16


def pair_of(spec, T_base_side, seed, kind="urban"):
    mounted = {
        "top": Mounted(pose(1.2, 0, 1.9), AROUND),
        "side": Mounted(T_base_side, spec, late_s=LATE_S, phase_s=0.03),
    }
    return swept_streets(mounted, seed=seed, moments=MOMENTS, environment=kind, rate_hz=1.0)


@pytest.fixture(scope="module")
def street():
    return pair_of(FORWARD, pose(3.6, 0.1, 0.7), 51)


def true_pose(T_base_side=None):
    return inverse(pose(1.2, 0, 1.9)) @ (pose(3.6, 0.1, 0.7) if T_base_side is None else T_base_side)


def given(street):
    deskewed = street.nominal["top"], street.nominal["side"]
    return LidarPair(street.sweeps["top"], street.sweeps["side"], pose(1.2, 0, 1.9), deskewed)


def errors(evidence, T):
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
    street, T = pair_of(spec, T_base_side, seed, kind), true_pose(T_base_side)
    start = perturb_exactly(T, np.radians(off_deg), 0.05, np.random.default_rng(seed))
    evidence = estimate_lidar_lidar(EDGE, given(street), street.ego, start, street.scenes)
    error, sigma = errors(evidence, T)
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
def test_a_lidar_that_turned_at_noon_shows_it(street):
    R = exp_so3(np.radians([0.0, 0.0, 1.0]))
    later = [replace(s, xyz_m=s.xyz_m @ R) for s in street.sweeps["side"][MOMENTS // 2 :]]
    pair = replace(given(street), child=[*street.sweeps["side"][: MOMENTS // 2], *later])
    found = estimate_lidar_lidar(EDGE, pair, street.ego, true_pose(), street.scenes).parts
    assert abs(found.sigmas(PART_FLOOR_RAD)[2]) > MOVED_SIGMAS
    assert 0.5 < np.degrees(abs(found.step[2])) < 1.3


@pytest.mark.slow
def test_lidars_without_overlap_have_no_edge(street):
    back = [replace(s, xyz_m=s.xyz_m - [400.0, 0, 0]) for s in street.sweeps["side"]]
    with pytest.raises(SolveError, match="lie on surfaces of the other"):
        estimate_lidar_lidar(EDGE, replace(given(street), child=back), street.ego, true_pose(), street.scenes)


@pytest.mark.slow
def test_an_empty_square_shows_height_and_tilt_alone(street):
    def flat(sweeps):
        kept = [(s, np.abs(s.xyz_m[:, 1]) < 30) for s in sweeps]
        return [chosen(s, k & s.is_ground) for s, k in kept]

    pair = replace(given(street), parent=flat(street.sweeps["top"]), child=flat(street.sweeps["side"]))
    evidence = estimate_lidar_lidar(EDGE, pair, street.ego, true_pose(), street.scenes)
    assert np.linalg.matrix_rank(evidence.information, tol=1e-6 * evidence.information.max()) == 3
    shift = np.r_[np.zeros(3), 1.0, 0, 0, 0]  # of the child along the parent's x
    assert shift @ evidence.information @ shift < 1.0


def test_the_gradient_of_a_small_error_is_what_the_information_says():
    """In a room of exact planes, seen from a turning car: the error is found by one Gauss-Newton step."""
    rng = np.random.default_rng(4)

    def room(count, half_m):
        a, b = rng.uniform(-half_m, half_m, (2, count, 3))
        high = 2.2 + b / 4
        walls = [np.c_[a[:, :2], 0 * b[:, 0]], np.c_[a[:, 2], 8.0 + 0 * b[:, 0], high[:, 0]],
                 np.c_[9.0 + 0 * b[:, 1], b[:, 1], high[:, 2]]]  # fmt: skip
        return np.concatenate(walls)

    motion, dt, gap = np.array([0, 0, 0.3, 8.0, 0.2, 0]), 0.02, 0.04
    surfaces = Surfaces(room(3000, 8.0))
    child = transform_points(inverse(exp_se3(motion * (gap + dt))), room(400, 5.0))
    moment = _Moment(surfaces, child, gap, motion, 0)
    for off in [*np.eye(7), *rng.normal(size=(3, 7))]:
        x = 3e-4 * off * [0.3, 0.3, 0.3, 1, 1, 1, 0.1]
        found = _equations([moment], inverse(exp_se3(x[:6])), dt - x[6], 0.5)
        predicted = found.H[0] @ x
        assert found.g[0] == pytest.approx(predicted, abs=0.05 * np.abs(predicted).max())

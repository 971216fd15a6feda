"""A lidar's roll, pitch, yaw and height over the base, by the road and the way: within sigma, and nothing made up."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.edges.lidar_base import estimate_lidar_base
from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.calibrate.verify.constancy import MOVED_SIGMAS, PART_FLOOR_RAD
from pipeline.objective.ego_motion import EgoMotion
from pipeline.rig.changes import change_between, change_jacobian
from pipeline.rig.graph import BASE, Edge, Sensor
from pipeline.rig.se3 import adjoint, exp_se3, exp_so3, inverse, perturb_exactly
from tests.makers.swept_streets import AROUND, Mounted, chosen, pose, swept_streets

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


@pytest.mark.parametrize(
    ("seed", "kind", "spec"),
    [
        (32, "urban", None),
        pytest.param(33, "highway", None, marks=pytest.mark.slow),
        pytest.param(34, "urban", AROUND, marks=pytest.mark.slow),
    ],
)
def test_a_pose_of_known_truth_comes_out_within_its_sigma(seed, kind, spec):
    mounted = Mounted(T_BASE_TOP) if spec is None else Mounted(T_BASE_TOP, spec)
    street = swept_streets({"top": mounted}, seed=seed, moments=36, environment=kind, rate_hz=1.0)
    evidence = estimated(street)
    error, sigma = errors(evidence, T_BASE_TOP)
    assert (np.abs(error) < LIMITS).all(), error
    assert (np.abs(error) < 4 * sigma + [1e-4, 1e-4, 1e-4, 1e-3]).all(), error / sigma
    assert (sigma < LIMITS).all(), sigma
    assert not evidence.checks


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


def test_a_car_that_parks_on_a_kerb_for_half_of_the_day_is_one_scene(street):
    sweeps = street.sweeps["top"]
    parked = [turned(sweeps[-1], [np.radians(4.0), 0.0, 0.0])] * len(sweeps)
    ego = EgoMotion(
        np.concatenate([street.ego.velocity_mps, 0 * street.ego.velocity_mps]),
        np.concatenate([street.ego.yaw_rate_radps, 0 * street.ego.yaw_rate_radps]),
        np.concatenate([street.ego.covariance] * 2),
    )
    scene, block = (
        np.concatenate([a, np.full(len(a), a[-1] + 1)]) for a in (street.scenes.scene, street.scenes.block)
    )
    error, _ = errors(
        estimated(replace(street, sweeps={"top": [*sweeps, *parked]}, ego=ego, scenes=Scenes(scene, block))),
        T_BASE_TOP,
    )
    assert abs(error[0]) < LIMITS[0]


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

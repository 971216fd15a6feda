"""A lidar's roll, pitch, yaw and height over the base, by the road and the way: within sigma, and nothing made up."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.edges.lidar_base import estimate_lidar_base
from pipeline.calibrate.verify.constancy import MOVED_SIGMAS, PART_FLOOR_RAD
from pipeline.rig.changes import change_between, change_jacobian
from pipeline.rig.graph import BASE, Edge, Sensor
from pipeline.rig.se3 import adjoint, exp_so3, inverse, perturb_exactly
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


def test_an_empty_square_shows_no_yaw_and_still_the_road(street):
    flat = [chosen(s, s.is_ground) for s in street.sweeps["top"]]
    evidence = estimated(replace(street, sweeps={"top": flat}))
    error, sigma = errors(evidence, T_BASE_TOP)
    assert not np.isfinite(sigma[2])
    assert any("yaw" in note for note in evidence.notes)
    assert (np.abs(error[[0, 1, 3]]) < LIMITS[[0, 1, 3]]).all()


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


def test_a_measured_height_is_one_more_measurement_and_is_checked(street, evidence):
    alone, _ = by_axis(evidence)
    height_m = float(T_BASE_TOP[2, 3])
    agreed = estimated(street, height_m=(height_m, 0.01))
    assert not agreed.checks
    wrong = estimated(street, height_m=(height_m + 0.2, 0.01))
    assert any("height" in c.sentence for c in wrong.checks)
    assert by_axis(agreed)[0][2, 3] == pytest.approx(alone[2, 3], abs=0.01)


def turned(sweep, rotation_base):
    """What the sweep would show of a body that is turned about the lidar by a rotation vector in the base."""
    R = T_BASE_TOP[:3, :3].T @ exp_so3(np.array(rotation_base)) @ T_BASE_TOP[:3, :3]
    return replace(sweep, xyz_m=sweep.xyz_m @ R)

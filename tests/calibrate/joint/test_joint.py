"""Method `joint`: the hard loop, what camera and radar alone may contradict, pairs that cannot be solved."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.estimate import Aligned, AlignmentState
from pipeline.calibrate.joint.camera_lidar.initialise import Basin
from pipeline.calibrate.joint.camera_lidar.intrinsics import DayIntrinsics
from pipeline.calibrate.joint.composition import compose_pairs
from pipeline.calibrate.joint.solve import solve_joint
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import PairEstimate, Prior
from pipeline.geometry.changes import change_jacobian
from pipeline.geometry.se3 import adjoint, exp_se3, log_se3, perturb_exactly
from schemas.calibrations import PAIRS
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR

PRIOR = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.05)
SMALL = np.diag([np.radians(0.1) ** 2] * 3 + [0.02**2] * 3)


def estimate(pair, T, observable=(True,) * 6, **changes):
    known = np.array(observable)
    return replace(PairEstimate(pair, T, SMALL, known.astype(float), known, 50), **changes)


def camera_lidar():
    return estimate("camera_lidar", T_CAMERA_LIDAR, time_offset_s=0.004, time_offset_sigma_s=0.001)


def lidar_radar():
    return estimate("lidar_radar", T_LIDAR_RADAR, time_offset_s=0.020, time_offset_sigma_s=0.002)


def alone(yaw_rad=0.0, observable=(True, True, False, False, False, False)):
    T = exp_se3(np.array([0, yaw_rad, 0.5, 0, 0, 0])) @ T_CAMERA_LIDAR @ T_LIDAR_RADAR
    return estimate("camera_radar", T, observable)


def test_camera_radar_closes_the_loop_and_carries_both_uncertainties():
    found, _, _ = compose_pairs(camera_lidar(), lidar_radar(), alone(), PRIOR)
    assert np.allclose(found.T, T_CAMERA_LIDAR @ T_LIDAR_RADAR)
    A = adjoint(T_CAMERA_LIDAR)
    assert np.allclose(found.covariance, SMALL + A @ SMALL @ A.T)
    assert found.time_offset_s == pytest.approx(0.024)
    assert found.time_offset_sigma_s == pytest.approx(np.hypot(0.001, 0.002))


def test_the_composed_covariance_is_that_of_composed_errors():
    rng = np.random.default_rng(0)
    found, _, _ = compose_pairs(camera_lidar(), lidar_radar(), alone(), PRIOR)
    first, second = exp_se3(np.swapaxes(rng.multivariate_normal(np.zeros(6), SMALL, (4000, 2)), 0, 1))
    errors = log_se3(first @ T_CAMERA_LIDAR @ second @ T_LIDAR_RADAR @ np.linalg.inv(found.T))
    assert np.allclose(np.std(errors, axis=0), np.sqrt(np.diag(found.covariance)), rtol=0.06)


def test_what_one_factor_leaves_to_the_prior_rests_on_it_in_the_composed_pair_too():
    # Radar height and roll are kept at the prior: lidar axes x ahead, y left, z up are camera axes z, -x, -y.
    kept = np.diag([np.radians(2.0) ** 2, *[np.radians(0.1) ** 2] * 2, 0.02**2, 0.02**2, 0.05**2])
    lever = np.linalg.inv(change_jacobian(T_LIDAR_RADAR))
    radar = estimate(
        "lidar_radar",
        T_LIDAR_RADAR,
        (False, True, True, True, True, False),
        covariance=lever @ kept @ lever.T,
    )
    found, _, _ = compose_pairs(camera_lidar(), radar, alone(), PRIOR)
    assert found.observable.tolist() == [True, True, False, True, False, True]
    both, _, _ = compose_pairs(camera_lidar(), lidar_radar(), alone(), PRIOR)
    assert both.observable.all()


def test_only_rotations_that_camera_and_radar_alone_determine_are_compared():
    _, loop_rad, failed = compose_pairs(camera_lidar(), lidar_radar(), alone(), PRIOR)
    assert failed == []  # roll is off by half a radian, but was not determined
    assert loop_rad < np.radians(8)
    _, nothing, failed = compose_pairs(camera_lidar(), lidar_radar(), alone(observable=(False,) * 6), PRIOR)
    assert nothing is None
    assert failed == []


def test_a_camera_that_contradicts_the_loop_fails_a_check():
    T = exp_se3(np.array([0, np.radians(2.0), 0, 0, 0, 0])) @ T_CAMERA_LIDAR @ T_LIDAR_RADAR
    found, loop_rad, failed = compose_pairs(
        camera_lidar(),
        lidar_radar(),
        estimate("camera_radar", T, (True, True, True, False, False, False)),
        PRIOR,
    )
    assert loop_rad == pytest.approx(np.radians(2.0), rel=1e-3)
    assert found.diagnostics["alone_ry_rad"] == pytest.approx(np.radians(2.0), rel=1e-3)
    assert len(failed) == 1
    assert "yaw" in failed[0].sentence


def test_pairs_that_cannot_be_solved_keep_the_prior_and_fail_a_check():
    day = street_day(3)
    solution = solve_joint(dict.fromkeys(PAIRS, day), PRIOR, SolveConfig(), seed=0)
    for pair in ("camera_lidar", "lidar_radar"):
        assert np.array_equal(solution.pairs[pair].T, PRIOR.of(pair))
        assert not solution.pairs[pair].observable.any()
        assert solution.failed_checks[pair]
    assert np.allclose(solution.pairs["camera_radar"].T, PRIOR.T_camera_radar)
    assert len(solution.failed_checks["camera_radar"]) >= 2


def solved_with_camera(monkeypatch, day, vouched_by):
    """The solution of a day whose camera-lidar is put in its place: at the truth, sure, and so vouched for."""
    basin = Basin(AlignmentState(T_CAMERA_LIDAR), None, "prior", 4, vouched_by, float(np.radians(2.6)), 0.1)
    covariance = np.diag([np.radians(0.02) ** 2] * 3 + [0.01**2] * 3)
    aligned = object.__new__(Aligned)  # without the terms and frames that nothing here looks at
    object.__setattr__(aligned, "basin", basin)
    object.__setattr__(aligned, "state", AlignmentState(T_CAMERA_LIDAR))
    agreeing = DayIntrinsics(1.0, 0.004, np.zeros(2), np.ones(2), (900.0, 900.0))
    object.__setattr__(aligned, "intrinsics", agreeing)
    monkeypatch.setattr(Aligned, "covariance", covariance)
    monkeypatch.setattr("pipeline.calibrate.joint.solve.align_camera_lidar", lambda *_: aligned)
    headings = []

    def analysed(_aligned, _rng, *, heading):
        headings.append(heading)
        return camera_lidar()

    monkeypatch.setattr("pipeline.calibrate.joint.solve.analyse_camera_lidar", analysed)
    return solve_joint(dict.fromkeys(PAIRS, day), PRIOR, SolveConfig(), seed=0), headings


def test_a_basin_that_no_other_origin_leads_to_disproves_both_camera_pairs_and_helps_nobody(monkeypatch):
    day = street_day(12)
    found, _ = solved_with_camera(monkeypatch, day, ("evolution",))
    assert not found.pairs["camera_lidar"].disproved
    assert found.pairs["lidar_radar"].diagnostics["boxes"] > 0
    lost, _ = solved_with_camera(monkeypatch, day, ())
    for pair in ("camera_lidar", "camera_radar"):
        assert "2.6 deg away" in lost.pairs[pair].disproved
    assert not lost.pairs["lidar_radar"].disproved
    assert lost.pairs["lidar_radar"].diagnostics["boxes"] == 0
    assert any("without its help" in note for note in lost.pairs["lidar_radar"].notes)


def test_what_rested_on_a_disbelieved_pair_is_solved_again_without_it(monkeypatch):
    found, headings = solved_with_camera(monkeypatch, street_day(12), ("evolution",))
    assert headings[-1] is not None
    without_camera = found.without(frozenset({"camera_lidar"}))
    assert without_camera.pairs["lidar_radar"].diagnostics["boxes"] == 0
    assert headings[-1] is not None
    without_radar = found.without(frozenset({"lidar_radar"}))
    assert without_radar.pairs["lidar_radar"].diagnostics["boxes"] > 0
    assert headings[-1] is None


def test_an_untriggered_camera_lidar_stays_at_the_prior_and_its_boxes_are_not_trusted():
    day = street_day(24)
    start = perturb_exactly(T_LIDAR_RADAR, np.radians(2.0), 0.05, np.random.default_rng(0))
    prior = Prior(T_CAMERA_LIDAR, start, np.radians(2.0), 0.05)
    told = []
    solution = solve_joint(
        dict.fromkeys(PAIRS, day), prior, SolveConfig(), seed=1, triggered=("lidar_radar",),
        progress=lambda done, total, what: told.append((done, total, what)),
    )  # fmt: skip
    assert np.array_equal(solution.pairs["camera_lidar"].T, T_CAMERA_LIDAR)
    assert (
        solution.pairs["lidar_radar"].diagnostics["boxes"] == 0
    )  # the camera's own 2 deg would go into roll and pitch
    error = log_se3(solution.pairs["lidar_radar"].T @ np.linalg.inv(T_LIDAR_RADAR))
    assert abs(error[2]) < np.radians(0.15)
    assert told[-1][0] == told[-1][1]

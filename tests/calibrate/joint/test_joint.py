"""Method `joint`: three pairs that rest on nothing of each other, their loop, pairs that cannot be solved."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.estimate import Aligned, AlignmentState
from pipeline.calibrate.joint.camera_lidar.initialise import Basin
from pipeline.calibrate.joint.camera_lidar.intrinsics import DayIntrinsics
from pipeline.calibrate.joint.solve import solve_joint
from pipeline.core.config import SolveConfig
from pipeline.objective.camera_lidar.kernel_settings import KernelSettings
from pipeline.objective.ego_motion import shown_heading
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.se3 import exp_se3, log_se3, perturb_exactly
from schemas.calibrations import PAIRS
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR

PRIOR = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.05)
SMALL = np.diag([np.radians(0.1) ** 2] * 3 + [0.02**2] * 3)


def estimate(pair, T, observable=(True,) * 6, **changes):
    known = np.array(observable)
    return replace(PairEstimate(pair, T, SMALL, known.astype(float), known, 50), **changes)


def three_pairs(yaw_rad=0.0, observable=(True, True, False, False, False, False)):
    """Camera-lidar and lidar-radar at the truth; camera-radar half a radian off in roll, and by as much in yaw."""
    T = exp_se3(np.array([0, yaw_rad, 0.5, 0, 0, 0])) @ T_CAMERA_LIDAR @ T_LIDAR_RADAR
    return {
        "camera_lidar": estimate("camera_lidar", T_CAMERA_LIDAR),
        "camera_radar": estimate("camera_radar", T, observable),
        "lidar_radar": estimate("lidar_radar", T_LIDAR_RADAR),
    }


def looped(monkeypatch, pairs):
    monkeypatch.setattr("pipeline.calibrate.joint.solve._solved", lambda pair, *_: (pairs[pair], []))
    return solve_joint({pair: [] for pair in PAIRS}, PRIOR, SolveConfig(), seed=0)


def test_the_loop_is_of_turns_that_camera_and_radar_alone_determine(monkeypatch):
    found = looped(monkeypatch, three_pairs(np.radians(2.0)))
    assert found.loop_rotation_rad == pytest.approx(np.radians(2.0), rel=0.1)  # roll was not determined
    sigma_rad = found.pairs["camera_radar"].diagnostics["loop_rotation_sigma_rad"]
    # Two turns of each of three pairs; a lever arm turns nothing.
    assert sigma_rad == pytest.approx(np.radians(0.1) * np.sqrt(6))
    assert found.loop_translation_m is None
    assert looped(monkeypatch, three_pairs(observable=(False,) * 6)).loop_rotation_rad is None


def test_pairs_that_cannot_be_solved_keep_the_prior_and_fail_a_check():
    day = street_day(3)
    solution = solve_joint(dict.fromkeys(PAIRS, day), PRIOR, SolveConfig(), seed=0)
    for pair in ("camera_lidar", "lidar_radar"):
        assert np.array_equal(solution.pairs[pair].T, PRIOR.of(pair))
        assert not solution.pairs[pair].observable.any()
        assert solution.failed_checks[pair]
    assert not solution.failed_checks.get("camera_radar")  # another pair's failure is none of its own


def solved_with_camera(monkeypatch, day, doubt, prior=PRIOR):
    """The solution of a day whose camera-lidar is put in its place: at the truth, sure, and so doubted."""
    kernel = KernelSettings.wide(4.0, 0)
    basin = Basin(
        AlignmentState(T_CAMERA_LIDAR), kernel, "prior", 4, (9.0, 9.0, 9.0), 12.0, 0.1, 9.0, None, doubt
    )
    aligned = object.__new__(Aligned)  # without the terms and frames that nothing here looks at
    object.__setattr__(aligned, "basin", basin)
    agreeing = DayIntrinsics(1.0, 0.004, np.zeros(2), np.ones(2), (900.0, 900.0))
    object.__setattr__(aligned, "intrinsics", agreeing)
    monkeypatch.setattr("pipeline.calibrate.joint.solve.align_camera_lidar", lambda *_: aligned)
    headings = []

    def analysed(_aligned, _rng, *, heading_rad):
        headings.append(heading_rad)
        return estimate("camera_lidar", T_CAMERA_LIDAR)

    monkeypatch.setattr("pipeline.calibrate.joint.solve.analyse_camera_lidar", analysed)
    return solve_joint(dict.fromkeys(PAIRS, day), prior, SolveConfig(), seed=0), headings


@pytest.mark.slow
def test_a_basin_in_doubt_disproves_its_own_pair_alone(monkeypatch):
    day = street_day(12)
    found, _ = solved_with_camera(monkeypatch, day, "")
    assert not found.pairs["camera_lidar"].disproved
    lost, _ = solved_with_camera(monkeypatch, day, "another end, 2.6 deg away")
    assert "2.6 deg away" in lost.pairs["camera_lidar"].disproved
    for pair in ("lidar_radar", "camera_radar"):
        assert not lost.pairs[pair].disproved
        assert np.array_equal(lost.pairs[pair].T, found.pairs[pair].T)  # nothing of the camera's is in them


def test_boxes_count_once_and_the_radar_s_turn_gives_the_heading(monkeypatch):
    found, headings = solved_with_camera(monkeypatch, street_day(12), "")
    assert "boxes" not in found.pairs["lidar_radar"].diagnostics
    assert found.pairs["camera_radar"].diagnostics["boxes"] > 0
    turned = found.pairs["lidar_radar"]
    assert headings[-1] == pytest.approx(shown_heading(street_day(12), turned.T))


def test_an_untriggered_camera_lidar_stays_at_the_prior_and_the_radar_is_found_without_it():
    day = street_day(24)
    start = perturb_exactly(T_LIDAR_RADAR, np.radians(2.0), 0.05, np.random.default_rng(0))
    prior = Prior(T_CAMERA_LIDAR, start, np.radians(2.0), 0.05)
    told = []
    solution = solve_joint(
        dict.fromkeys(PAIRS, day), prior, SolveConfig(), seed=1, triggered=("lidar_radar",),
        progress=lambda done, total, what: told.append((done, total, what)),
    )  # fmt: skip
    assert np.array_equal(solution.pairs["camera_lidar"].T, T_CAMERA_LIDAR)
    error = log_se3(solution.pairs["lidar_radar"].T @ np.linalg.inv(T_LIDAR_RADAR))
    assert abs(error[2]) < np.radians(0.15)
    assert told[-1][0] == told[-1][1]

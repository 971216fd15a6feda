"""Method `joint`: three pairs that rest on nothing of each other, their loop, and terms that are left out."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.calibrate.joint.camera_lidar.estimate import Aligned, AlignmentState
from pipeline.calibrate.joint.camera_lidar.initialise import Basin
from pipeline.calibrate.joint.camera_lidar.intrinsics import DayIntrinsics
from pipeline.calibrate.joint.solve import solve_joint
from pipeline.core.config import TERMS, SolveConfig
from pipeline.objective.camera_lidar.score import KernelSettings
from pipeline.objective.ego_motion import shown_heading
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.se3 import exp_se3, log_se3, perturb_exactly
from schemas.calibrations import PAIRS
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import PRIORS, T_CAMERA_LIDAR, make_day

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


@cache
def solve_without(*terms: str):
    config = SolveConfig(terms=tuple(t for t in TERMS if t not in terms))
    prior = replace(PRIOR, T_lidar_radar=PRIORS["lidar_radar"])
    return solve_joint(dict.fromkeys(PAIRS, make_day(10, seed=3)), prior, config, seed=1)


@pytest.mark.parametrize(
    "terms", [("edges", "reflectivity"), ("static", "moving"), ("edges", "edges"), ("edges", "colour"), ()]
)
def test_a_choice_of_terms_that_solves_nothing_or_names_one_twice_is_refused(terms):
    with pytest.raises(ValidationError):
        SolveConfig(terms=terms)


def test_without_time_offsets_none_is_estimated():
    pairs = solve_without("time_offsets").pairs
    for pair in ("camera_lidar", "lidar_radar"):
        # The stamps' constant gaps are +1 and -1 ms.
        assert abs(pairs[pair].time_offset_s - 1e-3) < 1e-4


def test_without_the_position_prior_positions_are_less_sure_and_what_the_day_leaves_open_is_open():
    kept, free = solve_without(), solve_without("translation_prior")
    for pair in ("camera_lidar", "lidar_radar"):
        sigma = [np.sqrt(np.diag(s.pairs[pair].covariance)[3:]) for s in (kept, free)]
        assert (sigma[1] > sigma[0]).all()
    assert not free.pairs["camera_lidar"].observable[5]  # along the camera's axis
    assert sigma[0].max() < 0.06


def test_without_static_detections_the_registration_says_nothing():
    alone = solve_without("static")
    both = solve_without()
    sigma = [np.sqrt(s.pairs["lidar_radar"].covariance[2, 2]) for s in (alone, both)]
    assert sigma[0] > sigma[1]

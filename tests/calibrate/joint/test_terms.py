"""Terms of method joint can be left out one at a time, and what is left out says nothing."""

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.calibrate.joint.solve import solve_joint
from pipeline.core.config import TERMS, SolveConfig
from pipeline.rig.estimates import Prior
from schemas.calibrations import PAIRS
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day

PRIOR = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.05)


def solve_without(*terms: str):
    config = SolveConfig(terms=tuple(t for t in TERMS if t not in terms))
    day = make_day(frames=10, seed=3)
    return solve_joint(dict.fromkeys(PAIRS, day), PRIOR, config, seed=1)


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

"""Alarms where a mounting or a clock lies many sigmas from its prior, and none where the day says nothing of it."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.calibrate.verify.day_checks import clock_alarms, prior_alarms
from pipeline.core.config import ChecksConfig, SolveConfig
from pipeline.rig.estimates import PairEstimate, Prior
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR

LIMITS = ChecksConfig()
SIGMA_M = 0.03
PRIOR = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(1.2), SIGMA_M)


def estimate_of(pair, kept=(), dt_s=0.0, **found):
    """A pair at its prior, with a few positions left to it."""
    observable = ~np.isin(np.arange(6), kept)
    covariance, timed = np.eye(6) * SIGMA_M**2, {"time_offset_s": dt_s, "time_offset_sigma_s": 0.005}
    return PairEstimate(
        pair, PRIOR.of(pair), covariance, observable * 1.0, observable, 50, diagnostics=found, **timed
    )


def test_a_position_left_to_the_prior_is_an_alarm_where_the_day_puts_it_elsewhere():
    z = {"own_z_prior": -2.0, "own_z_beyond": -2.0}
    cases = [
        ({"own_tx_m": 0.5, "own_tx_sigma_m": 0.1} | z, True),
        ({"own_tx_m": 0.1, "own_tx_sigma_m": 0.01} | z, False),  # a prior may be three sigmas off
        ({"own_tx_m": 0.5, "own_tx_sigma_m": 0.4} | z, False),  # the day does not know
        ({"own_tx_m": 0.5, "own_tx_sigma_m": 0.1} | z | {"own_z_beyond": 1.0}, False),  # a slope, no dip
    ]
    for found, is_alarm in cases:
        alarms = prior_alarms({"lidar_radar": estimate_of("lidar_radar", kept=[3], **found)}, PRIOR, LIMITS)
        assert [c.fault for c in alarms["lidar_radar"]] == ["prior"] * is_alarm


def test_a_clock_that_is_further_off_than_stated_is_an_alarm():
    for dt_s, named in ((0.12, []), (-0.5, ["time_offset"]), (0.5, ["time_offset"])):
        found = clock_alarms({"lidar_radar": estimate_of("lidar_radar", dt_s=dt_s)}, 0.05, LIMITS)
        assert [c.fault for c in found.get("lidar_radar", [])] == named
    assert not clock_alarms({"lidar_radar": estimate_of("lidar_radar", dt_s=0.5)}, 0.2, LIMITS)


@pytest.mark.parametrize(
    ("own", "is_alarm"), [((0.5, -5.0), True), ((0.5, -0.7), False), ((0.06, -5.0), False)]
)
def test_frames_that_align_far_better_at_another_offset_are_an_alarm_though_none_was_solved_for(
    own, is_alarm
):
    estimate = estimate_of("lidar_radar", own_dt_s=own[0], own_dt_z=own[1])
    found = clock_alarms({"lidar_radar": estimate}, 0.05, LIMITS)
    assert [c.fault for c in found.get("lidar_radar", [])] == ["time_offset"] * is_alarm


@pytest.mark.parametrize("off_m", [0.0, 0.4])
def test_a_radar_mounted_further_ahead_than_its_prior_says_is_found_though_x_is_left_to_the_prior(off_m):
    T = T_LIDAR_RADAR.copy()
    T[0, 3] += off_m
    prior = replace(PRIOR, T_lidar_radar=T, translation_sigma_m=0.01)
    found = estimate_lidar_radar(street_day(24, seed=5), prior, SolveConfig(), np.random.default_rng(0))
    alarms = prior_alarms({"lidar_radar": found}, prior, LIMITS)["lidar_radar"]
    own = found.diagnostics
    assert not found.observable[3]
    assert abs(own["own_tx_m"] + off_m) < 4 * own["own_tx_sigma_m"]
    assert [c.fault for c in alarms] == ["prior"] * (off_m > 0)

"""What restarts, halves and the registration contradict holds a lidar-radar record where it matters at the targets."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar.conclusions import lidar_radar_failures
from pipeline.calibrate.joint.solve import solve_joint
from pipeline.calibrate.records import Inputs
from pipeline.core.config import FleetConfig
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.store.partitions import Partition
from tests.makers.calibrated_days import records_of_rows
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR

PRIOR = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, float(np.radians(2.0)), 0.05)
SIGMA = np.array([*np.radians([0.3, 0.1, 0.02]), 0.01, 0.01, 0.02])
QUIET = {
    f"{of}_{key}": 0.0
    for of in ("restarts", "halves")
    for key in ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")
} | {f"registration_{axis}_{what}_rad": 0.01 for axis in ("roll", "pitch") for what in ("offset", "sigma")}


def estimate(**numbers):
    seen = np.ones(6, bool)
    return PairEstimate(
        "lidar_radar", np.eye(4), np.diag(SIGMA**2), seen.astype(float), seen, 40, diagnostics=QUIET | numbers
    )


def test_what_agrees_fails_nothing():
    assert lidar_radar_failures(estimate()) == []
    assert (
        lidar_radar_failures(estimate(restarts_rz_rad=np.radians(0.1), halves_rz_rad=np.radians(0.1))) == []
    )


def test_restarts_state_the_distance_of_the_other_end_as_one_change():
    (check,) = lidar_radar_failures(estimate(restarts_rz_rad=np.radians(0.2), restarts_ty_m=-0.06))
    assert check.sentence == "restarts disagree in yaw by +0.20 deg and y by -0.060 m"
    assert check.error == pytest.approx((0, 0, np.radians(0.2), 0, -0.06, 0))
    assert check.fault == "witnesses_disagree"


def test_halves_state_half_of_their_distance_in_what_the_day_determined():
    apart = estimate(halves_rz_rad=np.radians(0.4), halves_ry_rad=np.radians(0.1), halves_tz_m=1.0)
    (check,) = lidar_radar_failures(replace(apart, observable=np.arange(6) < 5))
    assert check.sentence == "disjoint halves disagree in yaw by +0.40 deg"
    assert check.error == pytest.approx((0, np.radians(0.05), np.radians(0.2), 0, 0, 0))


def test_the_registration_states_the_turn_that_it_would_make():
    (check,) = lidar_radar_failures(estimate(registration_pitch_offset_rad=np.radians(-8.0)))
    assert "the registration would turn pitch by -8.0 deg" in check.sentence
    assert check.error == pytest.approx((0, np.radians(-8.0), 0, 0, 0, 0))


@pytest.fixture(scope="module")
def street():
    return street_day(48, seed=3)


def record_with(street, **numbers):
    """The record of a solved day whose solver found these numbers besides."""
    fleet = FleetConfig.model_validate(
        {"fleet": {"name": "f"}, "rigs": {"default": THREE_SENSORS}, "vehicles": {"v": {}}}
    )

    def solver(*args, **kwargs):
        solution = solve_joint(*args, **kwargs)
        own = solution.pairs["lidar_radar"]
        found = replace(own, diagnostics=own.diagnostics | numbers)
        failed = solution.failed_checks | {"lidar_radar": lidar_radar_failures(found)}
        return replace(solution, pairs=solution.pairs | {"lidar_radar": found}, failed_checks=failed)

    about = Inputs(Partition("v", "2024-05-06"), "joint", "k", 1, (), pairs=("lidar_radar",))
    (record,) = records_of_rows(street, PRIOR, fleet, about, solver=solver)
    return record


@pytest.mark.slow
def test_through_the_stage_restarts_hold_where_the_other_end_is_no_good(street):
    assert record_with(street).status == "accepted"
    little = record_with(street, restarts_rz_rad=np.radians(0.2), restarts_ty_m=-0.05)
    assert (little.status, little.faults) == ("accepted", ["witnesses_disagree"])
    assert "restarts disagree in yaw" in little.reason
    assert "at the targets, within the limit" in little.reason
    much = record_with(street, restarts_rz_rad=np.radians(0.6))
    assert (much.status, much.faults) == ("held", ["witnesses_disagree"])


@pytest.mark.slow
def test_through_the_stage_a_pitch_in_doubt_certifies_no_elevation_and_costs_no_azimuth(street):
    doubted = record_with(street, registration_pitch_offset_rad=np.radians(9.0))
    assert (doubted.status, doubted.determined) == ("accepted", ["azimuth"])
    assert "elevation not certified" in doubted.reason
    assert np.sqrt(np.diag(np.reshape(doubted.covariance, (6, 6)))[1]) > np.radians(1.0)

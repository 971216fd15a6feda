"""Vehicles of the study of the charts' power err as the records that they are made of say."""

import numpy as np
import pytest

from pipeline.geometry.se3 import exp_se3, inverse, log_se3
from tests.benchmarks.studies.drift_charts import Case
from tests.benchmarks.studies.drift_power import CASES, Records, make_vehicle, power, read_records

PAIRS = ("camera_lidar", "lidar_radar")


def records(sigma_deg):
    """Two records of one rig, turns known to `sigma_deg` and twice that, shifts to millimetres; nothing in common."""
    one = np.diag([np.radians(sigma_deg)] * 3 + [0.003] * 3) ** 2
    T = {"camera_lidar": exp_se3(np.array([1.2, -1.2, 1.2, 0.0, 0.1, 0.2])), "lidar_radar": np.eye(4)}
    varying = {pair: np.stack([one, 4 * one]) for pair in PAIRS}
    everything = {pair: np.ones((2, 6), bool) for pair in (*PAIRS, "camera_radar")}
    return Records(T, varying, {pair: np.zeros((2, 6, 6)) for pair in PAIRS}, everything)


def test_days_scatter_as_their_records_say_and_are_as_alike_as_asked():
    made = records(0.1)
    days = make_vehicle(made, 0.6, Case("nothing", days=4000), np.random.default_rng(3)).pairs["camera_lidar"]
    error = np.array([log_se3(T @ inverse(made.T["camera_lidar"])) for T in days.T])
    # Half of the days at .1 deg, half at .2.
    assert np.degrees(error[:, :3].std(axis=0)) == pytest.approx([0.158] * 3, rel=0.1)
    z = error[:, 0] / days.sigma[:, 0]
    assert z.std() == pytest.approx(1.0, abs=0.06)
    assert np.corrcoef(z[1:], z[:-1])[0, 1] == pytest.approx(0.6, abs=0.06)


def test_a_turn_of_thirty_sigmas_is_found_by_its_sensor_and_one_within_a_sigma_is_not():
    step = next(case for case in CASES if case.name == "camera yaw .3")
    step = Case(step.name, step.sensor, step.twist, on=40, days=60)
    sure = power(records(0.01), 0.0, step, 2, 4, (5, 1))
    assert (sure["movers"], sure["right_within_3"], sure["others_red"]) == (4, 4, 0)
    vague = power(records(0.5), 0.0, step, 2, 4, (5, 1))
    assert vague["right_within_12"] == 0


def test_the_committed_records_are_of_days_as_unsure_as_accepted_ones_are():
    assert read_records("demo").turn_sigmas_deg("camera_lidar") == pytest.approx(
        [0.03, 0.04, 0.04], abs=0.008
    )
    assert read_records("real car").turn_sigmas_deg("camera_lidar") == pytest.approx(
        [0.04, 0.05, 0.05], abs=0.015
    )

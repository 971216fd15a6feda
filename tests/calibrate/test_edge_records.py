"""Edges to the vehicle frame and between lidars are judged as pairs are: range, prior, number, claims."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.calibrate.edges.radar_base import estimate_radar_base
from pipeline.calibrate.judging import EdgeJudging
from pipeline.calibrate.records import Inputs, record_of_edge
from pipeline.rig.estimates import EdgeEvidence, OtherScenes
from pipeline.rig.graph import BASE, Edge, Sensor
from pipeline.rig.prior import RigPrior
from pipeline.rig.se3 import change_between, exp_so3, from_rotation_translation, inverse
from pipeline.store.partitions import Partition
from tests.calibrate.edges.test_radar_base import ALL, EDGE, STAMPS, day, mounted
from tests.makers.written_logs import fleet_config

FLEET = fleet_config()
ABOUT = Inputs(Partition("car", "2026-03-02"), "joint", "w", 0, ())
TOP = Sensor("top", "lidar")
SIGMAS = (float(np.radians(2.0)), 0.03)


def turned(T, rpy_deg=(0.0, 0.0, 0.0), xyz_m=(0.0, 0.0, 0.0)):
    """A sensor turned about its own origin and shifted, in axes of the base."""
    return from_rotation_translation(exp_so3(np.radians(rpy_deg)) @ T[:3, :3], T[:3, 3] + xyz_m)


def prior_of(edge, T_base_sensor, sigmas=SIGMAS):
    name = edge.parent.name
    return RigPrior(
        edge.sensors, edge.parent, {(name, "base"): inverse(T_base_sensor)}, {name: sigmas, "base": sigmas}
    )


def judgement(evidence, prior):
    judging = EdgeJudging.of(evidence, prior, {}, FLEET)
    return judging, judging.edge(judging.estimate, evidence.checks, False)


def judged(evidence, T_base_sensor, sigmas=SIGMAS):
    judging, found = judgement(evidence, prior_of(evidence.edge, T_base_sensor, sigmas))
    left = SimpleNamespace(estimate=judging.estimate, against=found.verdict.against)
    return left, record_of_edge(ABOUT, judging, 200, judging.estimate, found)


def radar_day(prior_off_deg):
    """A radar of known place, and its evidence from a prior that is turned in its bracket."""
    T = mounted(50.0)
    radar, ego = day(T, off_deg=prior_off_deg)
    return T, radar.T_base_radar, estimate_radar_base(EDGE, radar, ego, STAMPS, ALL)


def sure(edge, T_base_sensor, frames=40):
    """Evidence that knows every axis well."""
    return EdgeEvidence(edge, inverse(T_base_sensor), 0.0, np.eye(7) * 1e6, np.zeros(7), frames_used=frames)


def test_a_radar_within_its_prior_is_accepted_for_its_azimuth_and_used():
    T, prior, evidence = radar_day(2.0)
    found, record = judged(evidence, prior)
    assert (record.status, record.determined, record.faults) == ("accepted", ["azimuth"], [])
    assert found.against == ()
    assert abs(change_between(T, inverse(found.estimate.T))[2]) < np.radians(0.1)
    assert record.limit_rad == pytest.approx(np.radians(0.4))
    assert record.score > 0


@pytest.mark.parametrize(
    ("off_deg", "words"), [(9.0, "yaw moved by 4."), (25.0, "beyond the search range"), (179.0, "")]
)
def test_a_radar_far_from_its_prior_is_held_names_the_prior_and_is_not_used(off_deg, words):
    _, prior, evidence = radar_day(off_deg)
    found, record = judged(evidence, prior)
    assert (record.status, record.determined, record.faults) == ("held", [], ["prior"])
    assert words in record.reason
    assert [check.fault for check in found.against] == ["prior"]
    assert record.diagnostics["disproved"] == float(off_deg > 20)


def test_a_sensor_that_turned_in_its_bracket_is_not_shifted_by_its_lever_arm():
    T = mounted(0.0)  # 3.6 m before the base: six degrees are .38 m there
    prior = turned(T, (0.0, 0.0, 6.0))
    assert np.abs(inverse(prior)[:3, 3] - inverse(T)[:3, 3]).max() > 0.3
    assert judged(sure(EDGE, T), prior)[1].status == "accepted"


@pytest.mark.parametrize(
    ("rpy_deg", "z_m", "words"),
    [((0, 0, 0), 0.5, "0.50 m off the prior, beyond"), ((0, 9, 0), 0, "pitch moved by 4.5")],
)
def test_a_lidar_far_from_its_prior_is_held(rpy_deg, z_m, words):
    T, edge = turned(np.eye(4), xyz_m=(1.2, 0.0, 1.8)), Edge(TOP, BASE)
    assert judged(sure(edge, T), T)[1].status == "accepted"
    found, record = judged(sure(edge, T), turned(T, rpy_deg, (0.0, 0.0, z_m)))
    assert (record.status, record.faults) == ("held", ["prior"])
    assert words in record.reason
    assert found.against


def test_scenes_that_contradict_a_fit_hold_it_by_what_they_would_move_and_name_it():
    T = mounted(0.0)

    def beside(shift_deg):
        shift, covariance = np.zeros(6), np.diag([0.0, 0.0, np.radians(0.05) ** 2, 0.0, 0.0, 0.0])
        shift[2] = np.radians(shift_deg)
        return judged(replace(sure(EDGE, T), others=OtherScenes(shift, covariance)), T)

    found, record = beside(0.5)
    assert (record.status, record.faults, record.determined) == ("held", ["witnesses_disagree"], [])
    assert "azimuth: held-out frames put it 0.50 deg off" in record.reason
    assert found.against
    assert beside(0.1)[1].status == "accepted"  # two sigmas
    assert beside(0.2)[1].status == "accepted"  # four, and within the limit
    assert record.diagnostics["holdout_azimuth_shift_rad"] == pytest.approx(np.radians(0.5), rel=0.05)


@pytest.mark.parametrize(("after", "status"), [(0.3, "accepted"), (0.5, "held"), (0.7, "held")])
def test_two_lidars_need_a_better_alignment_of_scenes_that_took_no_part(after, status):
    edge, T = Edge(TOP, Sensor("grille", "lidar")), turned(np.eye(4), xyz_m=(2.0, 0.0, -1.4))
    prior = RigPrior(edge.sensors, TOP, {("top", "grille"): T}, dict.fromkeys(("top", "grille"), SIGMAS))
    noise = np.random.default_rng(3).normal(0, 0.01, (2, 30))
    cost = (0.5 + noise[0], after + noise[1], np.arange(30))
    others = OtherScenes(np.zeros(6), np.zeros((6, 6)), cost)
    moved = turned(T, (0.0, 0.0, 1.0))
    evidence = EdgeEvidence(edge, moved, 0.0, np.eye(7) * 1e6, np.zeros(7), frames_used=30, others=others)
    assert judgement(evidence, prior)[1].verdict.status == status


def test_an_edge_that_is_only_unsure_is_held_and_used():
    T = mounted(0.0)
    unsure = replace(sure(EDGE, T), information=np.eye(7) * np.radians(0.4) ** -2)
    found, record = judged(unsure, T)
    assert record.status == "held"
    assert record.diagnostics["unsure_only"] == 1.0
    assert found.against == ()

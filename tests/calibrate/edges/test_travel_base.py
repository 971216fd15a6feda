"""Sensors by the car's own travel, in a rig without a vehicle frame: against truth, and against labels that lie."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.edges import camera_base, lidar_base, radar_base
from pipeline.calibrate.edges.on_base import DaySources
from pipeline.calibrate.edges.sweep_travel import with_travel
from pipeline.calibrate.records import Inputs
from pipeline.rig.estimates import Prior
from pipeline.rig.graph import BASE, EDGE_OF_PAIR, RigGraph, Sensor, edge_between
from pipeline.rig.se3 import change_between, exp_so3, from_rotation_translation, inverse, rotation_angle_rad
from pipeline.store import current
from pipeline.store.partitions import Partition
from schemas.observations import Observation
from tests.makers.calibrated_days import perturbed, records_of_rows, rig_prior_of
from tests.makers.simulated_days import simulated_day
from tests.makers.solve_scenes import make_day

KINDS = ("camera", "lidar", "radar")
OF_BOXES = [name for name in Observation.__dataclass_fields__ if name.startswith("road_user_")]
SENSORS = tuple(Sensor(kind, kind) for kind in KINDS)
GRAPH = RigGraph(SENSORS, tuple(EDGE_OF_PAIR.values()), SENSORS[1])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("day")
    return simulated_day(folder, frames=60, environment="urban", rig="paper-pairs", seed=174)


def prior_of(made):
    return Prior(made.truth["camera_lidar"], made.truth["lidar_radar"], np.radians(2.0), 0.05)


def records_of(made, rows, T_camera_lidar=None):
    about = Inputs(Partition("vehicle-1", "2026-03-02"), "joint", "k", 1, ())
    prior = perturbed(prior_of(made), (1.0, 0.02), 1)
    prior = prior if T_camera_lidar is None else replace(prior, T_camera_lidar=T_camera_lidar)
    return {r.pair: r for r in records_of_rows(rows, prior, made.fleet, about)}


def turned(o, deg, *, boxes=False):
    """The frame with borders and paint beside the picture that moves: to them, motion is turned; boxes with them."""
    none = {} if boxes else {name: getattr(o, name)[:0] for name in OF_BOXES}
    R = exp_so3(np.radians([0.0, deg, 0.0]))
    if o.motion_turn_rad is None:
        return replace(o, **none)
    return replace(o, **none, motion_turn_rad=R @ o.motion_turn_rad, motion_direction=R @ o.motion_direction)


@pytest.mark.slow
def test_camera_lidar_and_camera_radar_by_travel_alone_are_right_from_two_degrees(made):
    start = rig_prior_of(perturbed(prior_of(made), (2.0, 0.05), 3), SENSORS)
    graph, prior = with_travel(GRAPH, start, lambda _: made.observations)
    sources = DaySources(prior, ("lidar",), ("radar",), lambda _: made.observations)
    found = {
        s.name: of.solve(edge_between(s, BASE), sources)[0]
        for s, of in zip(SENSORS, (camera_base, lidar_base, radar_base), strict=True)
    }
    assert set(graph.edges) - set(GRAPH.edges) == {f.edge for f in found.values()}
    R = made.truth["camera_lidar"][:3, :3]
    for other, of in (("lidar", R), ("radar", made.truth["camera_radar"][:3, :3])):
        way = found["camera"].T[:3, 0] - of @ found[other].T[:3, 0]
        assert abs(np.degrees(way[0])) < 0.15
    tilt = change_between(found["camera"].T @ inverse(found["lidar"].T), made.truth["camera_lidar"])
    assert abs(np.degrees(tilt[0])) < 0.15


@pytest.mark.slow
def test_borders_that_motion_contradicts_are_held_by_name_though_held_out_frames_agree(made):
    good, beside = (records_of(made, [turned(o, deg) for o in made.observations]) for deg in (0.0, 0.8))
    assert set(good) == set(EDGE_OF_PAIR)  # the frame of travel has no record
    assert (good["camera_lidar"].status, good["camera_lidar"].faults) == ("accepted", [])
    assert (beside["camera_lidar"].status, beside["camera_lidar"].faults) == ("held", ["witnesses_disagree"])
    assert "camera-base" in beside["camera_lidar"].reason
    together = records_of(made, [turned(o, 0.8, boxes=True) for o in made.observations])
    for pair in ("camera_lidar", "camera_radar"):  # two that err alike do not outvote the motion
        assert (together[pair].status, together[pair].faults) == ("held", ["witnesses_disagree"])


@pytest.mark.slow
@pytest.mark.parametrize("off_deg", [(0.0, 30.0, 0.0), (0.0, -90.0, 0.0)])
def test_a_search_begins_where_the_camera_s_motion_shows_it_and_the_far_prior_holds_it(made, off_deg):
    T, R = made.truth["camera_lidar"], exp_so3(np.radians(off_deg))
    far = from_rotation_translation(R @ T[:3, :3], R @ T[:3, 3])
    found = records_of(made, made.observations, far)
    record = found["camera_lidar"]
    assert np.degrees(rotation_angle_rad(current.transform_of(record) @ inverse(T))) < 0.3
    assert (record.status, record.faults) == (found["camera_radar"].status, ["prior"]) == ("held", ["prior"])
    assert record.reason.startswith("by its motion camera is ")
    np.testing.assert_allclose(current.prior_of(record), far, atol=1e-9)
    assert found["lidar_radar"].status == "accepted"


@pytest.mark.parametrize("what", ["few motions", "no road", "a frame of its own"])
def test_a_day_without_motion_or_road_and_a_rig_with_a_frame_stay_as_they_are(what):
    shown = {"motion_turn_rad": np.zeros(3), "motion_direction": np.eye(3)[0], "motion_covariance": np.eye(6)}
    rows = [replace(o, motion_span_s=0.3, **shown) for o in make_day(9)]
    if what == "few motions":
        rows[7:] = [replace(o, motion_turn_rad=None) for o in rows[7:]]
    if what == "no road":
        rows = [replace(o, lidar_map_is_ground=np.zeros_like(o.lidar_map_is_ground)) for o in rows]
    T = from_rotation_translation(exp_so3(np.array([1.2, -1.2, 1.2])), np.zeros(3))
    prior = rig_prior_of(Prior(T, np.eye(4), 0.03, 0.05), SENSORS)
    graph = GRAPH
    if what == "a frame of its own":
        graph = RigGraph((*SENSORS, BASE), GRAPH.edges, SENSORS[1])
    assert with_travel(graph, prior, lambda _: rows) == (graph, prior)

"""The rig as a graph: names, ends, ways and cycles; transforms between any two sensors and their covariances."""

import numpy as np
import pytest

from pipeline.rig.graph import BASE, Edge, RigGraph, Sensor, edge_between
from pipeline.rig.prior import Extrinsics
from pipeline.rig.se3 import exp_se3

TOP, SIDE = Sensor("top", "lidar"), Sensor("side", "lidar")
FRONT, REAR = Sensor("front", "camera"), Sensor("rear", "camera")
CORNER = Sensor("corner", "radar")


def rig(*pairs):
    sensors = (TOP, SIDE, FRONT, REAR, CORNER, BASE)
    return RigGraph(sensors, tuple(edge_between(a, b) for a, b in pairs), TOP)


def test_only_edges_on_a_cycle_are_checked_by_others():
    graph = rig((FRONT, TOP), (TOP, CORNER), (FRONT, CORNER), (REAR, TOP))
    assert [e.name for e in graph.edges if graph.without([e]).path(*e.sensors)] == [
        "front-top",
        "top-corner",
        "front-corner",
    ]
    [cycle] = graph.cycles()
    assert {e.name for e in cycle} == {"front-top", "top-corner", "front-corner"}
    assert rig((FRONT, TOP), (TOP, CORNER)).cycles() == ()


def test_an_edge_of_what_shares_nothing_and_a_rig_that_contradicts_itself_are_refused():
    for make, a, b in ((edge_between, FRONT, REAR), (edge_between, TOP, TOP), (Edge, TOP, FRONT)):
        with pytest.raises(ValueError, match=r"joins two sensors|cannot be calibrated"):
            make(a, b)
    with pytest.raises(ValueError, match="two sensors are called top"):
        RigGraph((TOP, Sensor("top", "radar")), (), TOP)
    with pytest.raises(ValueError, match="no sensor of the rig"):
        RigGraph((TOP,), (), FRONT)
    with pytest.raises(ValueError, match="the rig has no front"):
        RigGraph((TOP,), (edge_between(TOP, FRONT),), TOP)
    with pytest.raises(ValueError, match="occurs twice"):
        RigGraph((TOP, FRONT), (edge_between(TOP, FRONT), edge_between(FRONT, TOP)), TOP)


def test_components_begin_with_the_references():
    graph = rig((FRONT, TOP), (CORNER, BASE))
    names = [[s.name for s in c] for c in graph.components()]
    assert names == [["top", "front"], ["side"], ["rear"], ["corner", "base"]]


def test_the_common_part_of_a_covariance_is_carried_as_the_whole_is():
    rng, names = np.random.default_rng(3), ("front", "corner")
    T = {"top": np.eye(4)} | {n: exp_se3(rng.normal(0, 0.7, 6)) for n in names}
    root = rng.normal(0, 0.01, (12, 12))
    poses = Extrinsics(TOP, T, names, root @ root.T, 0.25 * root @ root.T)
    quarter = poses.covariance_between("front", "corner", common=True)
    np.testing.assert_allclose(quarter, 0.25 * poses.covariance_between("front", "corner"))

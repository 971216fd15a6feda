"""The rig as a graph: names, ends, ways and cycles."""

import pytest

from pipeline.rig.graph import BASE, Edge, RigGraph, Sensor, edge_between

TOP, SIDE = Sensor("top", "lidar"), Sensor("side", "lidar")
FRONT, REAR = Sensor("front", "camera"), Sensor("rear", "camera")
CORNER = Sensor("corner", "radar")


def rig(*pairs):
    sensors = (TOP, SIDE, FRONT, REAR, CORNER, BASE)
    return RigGraph(sensors, tuple(edge_between(a, b) for a, b in pairs), TOP)


@pytest.mark.parametrize(("a", "b"), [(FRONT, REAR), (TOP, TOP)])
def test_what_shares_nothing_is_no_edge(a, b):
    with pytest.raises(ValueError, match=r"joins two sensors|cannot be calibrated"):
        edge_between(a, b)


def test_an_edge_in_the_wrong_order_is_refused():
    with pytest.raises(ValueError, match="cannot be calibrated"):
        Edge(TOP, FRONT)


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


def test_a_rig_that_contradicts_itself_is_refused():
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

"""The matrix of a rig: what each two sensors share, which edges are judged, and why others are not."""

from dataclasses import replace
from io import StringIO

from rich.console import Console

from jobs.check import print_rig
from pipeline.ingest.readiness import Evidence, judge_edge
from pipeline.ingest.rig_sample import dof_counts, rig_finding
from pipeline.rig.overlap import find_edges, overlaps_of
from tests.rig.test_overlap import VAN, rig

GOOD = Evidence(187, True, 0.9, 0.9, True, 64, 1.0, 0.8)
LEVEL = replace(GOOD, elevation_share=0.0)


def finding(silent=(), cut=(), **changes):
    prior, views = rig()
    overlaps = overlaps_of(prior, {name: view for name, view in views.items() if name not in silent})
    graph = find_edges(prior, overlaps)
    graph = graph.with_edges([edge for edge in graph.edges if edge.name not in cut])
    names = [name for name, *_ in VAN if name not in silent]
    verdicts = {e: judge_edge(e.name, e.kind, replace(GOOD, **changes)) for e in graph.edges}
    return rig_finding(graph, overlaps, [names] * 180 + [names[1:]] * 7, verdicts)


def test_every_two_sensors_that_could_be_calibrated_are_in_the_matrix_once():
    found = finding()
    # 5 cameras with 2 lidars and 3 radars, lidars with radars and with each other.
    assert len(found.pairs) == 5 * 5 + 2 * 3 + 1
    assert len({frozenset((p.parent, p.child)) for p in found.pairs}) == len(found.pairs)
    pairs = {(p.parent, p.child): p for p in found.pairs}
    assert (pairs["front", "top"].moments, pairs["tele", "top"].moments) == (180, 187)
    assert pairs["front", "top"].is_edge
    assert pairs["left", "ahead"].why_not == "their fields of view do not overlap"
    assert found.loose == []


def test_two_sensors_without_an_edge_say_why():
    pairs = {(p.parent, p.child): p for p in finding(cut=("front-fl",)).pairs}
    assert pairs["front", "fl"].why_not == "others share more"
    found = finding(silent=("rr",))
    pairs = {(p.parent, p.child): p for p in found.pairs}
    assert (pairs["rear", "rr"].is_edge, pairs["rear", "rr"].why_not) == (False, "no data of rr")
    assert found.loose == ["rr"]


def test_degrees_of_freedom_add_up_to_six_whatever_the_kind():
    for kind in ("camera_lidar", "camera_radar", "lidar_radar", "lidar_lidar", "lidar_base"):
        given, weak = dof_counts(judge_edge("a-b", kind, GOOD))
        assert given + weak == 6, kind
    assert dof_counts(judge_edge("a-b", "camera_lidar", GOOD)) == (3, 3)
    assert dof_counts(judge_edge("a-b", "radar_base", GOOD)) == (1, 1)
    assert dof_counts(judge_edge("a-b", "lidar_radar", LEVEL)) == (3, 0)
    assert dof_counts(judge_edge("a-b", "lidar_lidar", replace(GOOD, frames=0))) == (0, 0)


def test_the_matrix_is_printed_within_a_terminals_width_with_each_reason_once():
    text = StringIO()
    print_rig(Console(file=text, width=100), finding(elevation_share=0.0))
    lines = text.getvalue().splitlines()
    assert max(len(line) for line in lines) <= 100
    assert any(line.startswith("│front") and "76% 180" in line for line in lines)
    assert "poses refer to top" in text.getvalue()
    plain = " ".join(text.getvalue().split())
    assert plain.count("the radar measures no elevation") == 2  # two classes of DoF

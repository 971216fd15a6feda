"""What a pose is good for: no prior, however sure it says it is, makes a sensor accepted that the day did not see."""

import numpy as np
import pytest

from pipeline.calibrate.adjust.rig import AdjustedEdge, AdjustedRig, AdjustedSensor
from pipeline.calibrate.pose_rows import pose_rows
from pipeline.calibrate.records import Inputs
from pipeline.core.config import VerifyConfig
from pipeline.rig.checks import Check
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import RigGraph, Sensor, edge_between
from pipeline.store.partitions import Partition

TOP, NOSE = Sensor("top", "lidar"), Sensor("nose", "radar")
EDGE = edge_between(TOP, NOSE)
ABOUT = Inputs(Partition("car", "2026-03-02"), "joint", "key", 0, ())


@pytest.mark.parametrize(("seen", "status"), [(True, "accepted"), (False, "held")])
def test_a_sure_prior_alone_certifies_nothing(seen, status):
    tight = np.diag([1e-8] * 3 + [1e-6] * 3)
    poses = Extrinsics(TOP, {"top": np.eye(4), "nose": np.eye(4)}, ("nose",), tight, tight)
    found = AdjustedSensor(np.full(6, float(seen)), np.full(6, seen), (EDGE,), "", (), 0.01)
    graph = RigGraph((TOP, NOSE), (EDGE,), TOP)
    top, nose = pose_rows(
        ABOUT, graph, AdjustedRig(poses, tight, poses, {"nose": found}, {}), poses, {}, VerifyConfig()
    )
    assert (top.status, nose.status) == ("accepted", status)
    assert seen or "no degree of freedom" in nose.reason


def test_a_sensor_whose_edges_are_all_left_out_says_what_fault_they_name():
    checks = (Check("too few held-out frames"), Check("the nose moved", "moved_in_day"))
    evidence = EdgeEvidence(EDGE, np.eye(4), 0.0, np.eye(7), np.zeros(7), checks=checks)
    poses = Extrinsics(TOP, {"top": np.eye(4), "nose": np.eye(4)}, ("nose",), np.eye(6), np.eye(6))
    untied = AdjustedSensor(
        np.zeros(6), np.zeros(6, bool), (), "no edge of it can be used: top-nose", (), 0.01
    )
    edges = {EDGE: AdjustedEdge(evidence, None, checks)}
    found = AdjustedRig(poses, np.eye(6), poses, {"nose": untied}, edges)
    _, nose = pose_rows(ABOUT, RigGraph((TOP, NOSE), (EDGE,), TOP), found, poses, {}, VerifyConfig())
    assert (nose.status, nose.faults) == ("refused", ["moved_in_day"])
    assert nose.reason.endswith("top-nose; the nose moved")

"""What a pose is good for: no prior, however sure it says it is, makes a sensor accepted that the day did not see."""

import numpy as np
import pytest

from pipeline.calibrate.adjust.adjusted import AdjustedRig, AdjustedSensor
from pipeline.calibrate.pose_rows import pose_rows
from pipeline.calibrate.records import Inputs
from pipeline.config import VerifyConfig
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
    top, nose = pose_rows(ABOUT, graph, AdjustedRig(poses, tight, {"nose": found}, {}), {}, VerifyConfig())
    assert (top.status, nose.status) == ("accepted", status)
    assert seen or "no degree of freedom" in nose.reason

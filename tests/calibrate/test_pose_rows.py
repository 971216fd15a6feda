"""What a pose is good for, and who is suspected where an edge lies far from the prior."""

import numpy as np
import pytest

from pipeline.calibrate.adjust.rig import AdjustedEdge, AdjustedRig, AdjustedSensor
from pipeline.calibrate.adjusted_day import Concluded, SolvedEdge, adjusted_rig
from pipeline.calibrate.judging import Judged
from pipeline.calibrate.pose_rows import pose_rows
from pipeline.calibrate.records import Inputs
from pipeline.calibrate.rig_day import WrongPrior, wrong_priors
from pipeline.calibrate.verify.verdict import Verdict
from pipeline.core.config import ChecksConfig, VerifyConfig
from pipeline.rig.estimates import Check, EdgeEvidence, PairEstimate
from pipeline.rig.graph import RigGraph, Sensor, edge_between
from pipeline.rig.prior import Extrinsics, RigPrior
from pipeline.rig.se3 import change_covariance, change_jacobian, changed, from_rotation_translation
from pipeline.store.partitions import Partition
from schemas.calibrations import CalibrationRecord
from tests.makers.radar_scenes import T_LIDAR_RADAR
from tests.makers.solve_scenes import T_CAMERA_LIDAR

TOP, LEFT = Sensor("top", "lidar"), Sensor("left", "camera")
NOSE, REAR = Sensor("nose", "radar"), Sensor("rear", "radar")
EDGE = edge_between(TOP, NOSE)
ABOUT = Inputs(Partition("car", "2026-03-02"), "joint", "key", 0, ())


@pytest.mark.parametrize(("seen", "status"), [(True, "accepted"), (False, "held")])
def test_a_sure_prior_alone_certifies_nothing(seen, status):
    tight = np.diag([1e-8] * 3 + [1e-6] * 3)
    poses = Extrinsics(TOP, {"top": np.eye(4), "nose": np.eye(4)}, ("nose",), tight, tight)
    found = AdjustedSensor(np.full(6, float(seen)), np.full(6, seen), (EDGE,), "", (), 0.01)
    graph = RigGraph((TOP, NOSE), (EDGE,), TOP)
    nothing = CalibrationRecord(  # has no say in the pose
        vehicle="car", day="2026-03-02", method="joint", pair=EDGE.kind, parent_frame="top", child_frame="nose", seed=0,
        status="held", reason="too few frames", work_key="key", code_version="0", observable=[False] * 6,
    )  # fmt: skip
    top, nose = pose_rows(
        ABOUT, graph, AdjustedRig(poses, tight, poses, {"nose": found}, {}), poses, {}, VerifyConfig(),
        {"nose": Concluded(EDGE, nothing, is_adjusted=False)},
    )  # fmt: skip
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


BEHIND = from_rotation_translation(np.diag([-1.0, -1.0, 1.0]), np.array([-2.0, 0.0, -1.0]))
PRIOR = RigPrior(
    (LEFT, TOP, NOSE, REAR),
    TOP,
    {("left", "top"): T_CAMERA_LIDAR, ("top", "nose"): T_LIDAR_RADAR, ("top", "rear"): BEHIND},
    dict.fromkeys(("left", "top", "nose", "rear"), (float(np.radians(1.2)), 0.03)),
)
LIMITS = ChecksConfig()
X, Z = 3, 5


def solved(a, b, moved=(0.0,) * 6, kept=(), accuses=False, disproved=""):
    """An edge whose frames move it so from the prior, with a few unknowns left to the prior."""
    edge, seen = edge_between(a, b), ~np.isin(np.arange(6), kept)
    before = PRIOR.extrinsics()
    T_prior = before.between(*(s.name for s in edge.sensors))
    T = changed(T_prior, np.where(seen, moved, 0.0))
    of_prior = change_covariance(T_prior, before.covariance_between(*(s.name for s in edge.sensors)))
    sigma = np.where(seen, [0.0005] * 3 + [0.01] * 3, np.sqrt(np.diag(of_prior)))
    J = change_jacobian(T)
    information = np.zeros((7, 7))
    information[:6, :6] = J.T @ np.diag(seen / sigma**2) @ J
    C = np.linalg.inv(J) @ np.diag(sigma**2) @ np.linalg.inv(J).T
    own = PairEstimate(edge.kind, T, C, seen * 1.0, seen, 50, disproved=disproved)
    verdict = Verdict("held", "moved", faults=("prior",)) if accuses else Verdict("accepted", "")
    evidence = EdgeEvidence(
        edge, T, 0.0, information, np.zeros(7), frames_used=50, checks=(Check("moved"),) if accuses else ()
    )
    judged = Judged(verdict, None, {})
    return SolvedEdge(edge, own, judged, evidence, (), lambda *_, **__: judged, lambda *_: None)


def rig_of(edges):
    graph = RigGraph(PRIOR.nodes, tuple(e.edge for e in edges), TOP)
    return adjusted_rig(graph, PRIOR.extrinsics(), edges, 0.02)


def suspects(edges):
    return sorted(w.sensor for w in wrong_priors(edges, rig_of(edges), LIMITS))


def lower(shift_lidar=(0, 0, -0.3), **how):
    """The camera finds the lidar elsewhere."""
    moved = np.concatenate([np.zeros(3), T_CAMERA_LIDAR[:3, :3] @ np.array(shift_lidar)])
    return solved(LEFT, TOP, moved, accuses=True, **how)


def test_a_lidar_that_the_camera_finds_lower_is_suspected_and_radars_whose_height_rests_on_it_are_off_by_as_much():
    nose, rear = solved(TOP, NOSE, kept=[X, Z]), solved(TOP, REAR, kept=[X, Z])
    edges = [lower(), nose, rear]
    assert suspects(edges) == ["left", "top"]
    rig = rig_of(edges)
    (top,) = (w for w in wrong_priors(edges, rig, LIMITS) if w.sensor == "top")
    for edge in (nose.edge, rear.edge):
        check = top.check(rig, edge)
        assert check.fault == "prior"
        assert check.error == pytest.approx([0, 0, 0, 0, 0, 0.3], abs=0.02)
    (left,) = (w for w in wrong_priors(edges, rig, LIMITS) if w.sensor == "left")
    assert left.check(rig, nose.edge) is None


def test_a_radar_that_sits_further_ahead_is_off_as_far_for_the_camera_that_takes_its_place_from_the_prior():
    moved = np.array([0, 0, 0, 0.3, 0, 0])
    edges = [
        solved(TOP, NOSE, moved, accuses=True), solved(LEFT, TOP), solved(LEFT, NOSE, kept=[3, 4, 5])
    ]  # fmt: skip
    assert suspects(edges) == ["nose"]
    rig = rig_of(edges)
    (nose,) = wrong_priors(edges, rig, LIMITS)
    assert nose.check(rig, edges[1].edge) is None
    off = nose.check(rig, edges[2].edge).error
    assert off[3:] == pytest.approx(T_CAMERA_LIDAR[:3, :3] @ moved[3:], abs=0.03)


def test_a_pose_that_rests_on_it_certifies_no_direction_that_it_would_move_beyond_the_limit():
    edges = [lower(), solved(TOP, NOSE, kept=[X, Z]), solved(TOP, REAR, kept=[X])]
    rig = rig_of(edges)
    graph, before = RigGraph(PRIOR.nodes, tuple(e.edge for e in edges), TOP), PRIOR.extrinsics()
    up = np.array([0, 0, 0, 0, 0, 0.3])
    # Though the rear radar, which is asked for it, denies it.
    top = WrongPrior("top", edges[0].edge, np.tile(up, 3))
    found = {row.sensor: row for row in pose_rows(ABOUT, graph, rig, before, {}, VerifyConfig(), None, [top])}
    plain = {row.sensor: row for row in pose_rows(ABOUT, graph, rig, before, {}, VerifyConfig())}
    assert "elevation" not in found["nose"].determined
    assert "prior" in found["nose"].faults
    for what in ("status", "determined", "faults"):
        assert getattr(found["rear"], what) == getattr(plain["rear"], what)


def test_who_is_acquitted_and_who_is_at_fault_himself():
    unseen, aside = solved(TOP, NOSE, kept=[X, Z]), lower((0, 0.3, -0.3))
    assert suspects([lower(), solved(TOP, NOSE, kept=[X])]) == [
        "left"
    ]  # the radar measures its height itself
    # The radar sees where the lidar is along y: where it was. So it is the camera that hangs elsewhere.
    assert suspects([aside, unseen]) == ["left"]
    follows = solved(TOP, NOSE, np.array([0, 0, 0, 0, -0.3, 0]), kept=[X, Z], accuses=True)
    assert suspects([aside, follows]).count("top") == 2
    assert suspects([lower(disproved="lost"), unseen]) == []  # a basin that is lost accuses nobody

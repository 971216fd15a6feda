"""One rig per vehicle: what it rests on, how sure it is, and what it says of sensors that it lacks."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.audit.fusion import Mount
from pipeline.audit.pose_days import read_poses
from pipeline.audit.rig_states import rig_states
from pipeline.core.config import VerifyConfig
from pipeline.rig.graph import tie
from pipeline.rig.se3 import exp_se3, inverse, log_se3
from pipeline.store.commits import commit_records
from pipeline.store.current import transform_of
from schemas.drift import DriftFinding
from schemas.poses import POSES
from schemas.service_events import ServiceEvent
from tests.makers.rig_records import EDGES, POSE_SIGMA, T_TOP, pose_rows

TURN = np.array([0.0, np.radians(0.5), 0.0, 0.0, 0.0, 0.0])
LAST = "2026-03-30"
MOUNT = Mount(np.array([*np.radians([0.01] * 3), 0.001, 0.001, 0.001]), np.zeros(6), 0.0)
REFUSED = {"status": "refused", "reason": "none of its edges can be used", "covariance": None, "qw": None}


def states(lake, rows, events=(), findings=(), edges=()):
    commit_records(lake, POSES, rows)
    vehicle = rows[0].vehicle
    poses = read_poses(lake, "joint", "2026-03-01", LAST)[vehicle]
    mounts = {tie(sensor, poses.reference): MOUNT for sensor in poses.sensors}
    known, of_edges = (events, findings), dict.fromkeys(edges)
    found = rig_states((vehicle, LAST, "joint"), poses, of_edges, known, mounts, VerifyConfig())
    return {row.sensor or (row.parent_frame, row.child_frame): row for row in found}


def days(*numbers):
    return [f"2026-03-{n:02d}" for n in numbers]


def error(row, moved=None):
    """In sigmas of what its days say."""
    T = T_TOP[row.sensor] if moved is None else T_TOP[row.sensor] @ exp_se3(moved)
    return log_se3(transform_of(row) @ inverse(T)) / POSE_SIGMA


def found_change(sensor, edge, day="2026-03-04"):
    kinds = {"top": "lidar", "front": "camera", "left": "camera", "bumper": "radar", "corner": "radar"}
    return DriftFinding(
        vehicle="a", day=LAST, method="joint", pair="_".join(kinds[s] for s in edge), parent_frame=edge[0],
        child_frame=edge[1], dof="ry", status="RED", reason="", days_used=9, limit=0.1, start_day=day,
        start_day_latest=day, moved_sensor=sensor,
    )  # fmt: skip


def test_every_sensor_s_pose_is_its_accepted_days_as_one_and_surer_than_each_of_them(lake):
    rows = states(lake, pose_rows("a", 8, np.random.default_rng(1)))
    assert list(rows) == ["top", "front", "left", "bumper", "corner"]
    np.testing.assert_array_equal(transform_of(rows["top"]), np.eye(4))
    for row in [rows[s] for s in ("front", "left", "bumper", "corner")]:
        assert (row.pair, row.parent_frame, row.child_frame) == ("pose", "top", row.sensor)
        assert (row.status, row.days, row.since) == ("current", days(*range(1, 9)), None)
        sigma = np.sqrt(np.diag(row.covariance)) / POSE_SIGMA
        assert np.all((sigma > np.sqrt(0.1)) & (sigma < 0.85))
        assert np.abs(error(row) / sigma).max() < 4
        assert row.determined == ["azimuth", "elevation"]


def test_the_fused_rig_errs_as_its_covariance_says(lake):
    rng = np.random.default_rng(2)
    squares = []
    for vehicle in range(12):
        rows = states(lake, pose_rows(f"v{vehicle}", 6, rng))
        squares += [
            (e := log_se3(transform_of(r) @ inverse(T_TOP[s]))) @ np.linalg.solve(r.covariance, e)
            for s, r in rows.items()
            if s != "top"
        ]
    assert 3.0 < np.mean(squares) < 7.0  # six degrees of freedom; the common error is left out of the days


def test_a_sensor_without_a_usable_day_is_at_its_prior_with_what_its_last_day_shows(lake):
    of = {(k, "left"): REFUSED for k in range(4)}
    rows = states(lake, pose_rows("a", 4, np.random.default_rng(3), of=of), edges=EDGES)
    left = rows["left"]
    assert (left.status, left.days, left.determined) == ("prior", [], [])
    np.testing.assert_allclose(transform_of(left), T_TOP["left"], atol=1e-12)
    assert left.reason == "no usable day; 2026-03-04 refused: none of its edges can be used"
    assert rows["front"].status == "current"
    assert [rows[edge].status for edge in (("left", "top"), ("front", "top"))] == ["prior", "current"]
    assert "left is at its prior" in rows["left", "top"].reason


def test_days_held_for_their_sigma_alone_count_and_other_held_days_do_not(lake):
    of = {(1, "left"): {"status": "held", "unsure_only": True}, (2, "left"): {"status": "held"}}
    assert states(lake, pose_rows("a", 4, np.random.default_rng(3), of=of))["left"].days == days(1, 2, 4)


def test_every_edge_is_composed_of_the_poses(lake):
    rows = states(lake, pose_rows("a", 5, np.random.default_rng(2)), edges=EDGES)
    for edge in EDGES:
        a, b = (transform_of(rows[s.name]) for s in edge.sensors)
        row = rows[edge.parent.name, edge.child.name]
        np.testing.assert_allclose(transform_of(row), inverse(a) @ b, atol=1e-15)
        assert (row.pair, row.status) == (edge.kind, "current")
    loop = [transform_of(rows[e]) for e in (("front", "top"), ("top", "bumper"), ("front", "bumper"))]
    np.testing.assert_allclose(loop[0] @ loop[1] @ inverse(loop[2]), np.eye(4), atol=1e-12)


@pytest.mark.parametrize(
    ("sensor", "anew"), [("left", {"left"}), ("top", {"front", "left", "bumper", "corner"})]
)
def test_after_a_service_the_sensor_begins_anew_and_with_the_reference_all(lake, sensor, anew):
    event = ServiceEvent(vehicle="a", day="2026-03-04", sensor=sensor, kind="repair")
    rows = states(lake, pose_rows("a", 7, np.random.default_rng(4)), [event])
    for name in ("front", "left", "bumper", "corner"):
        assert rows[name].days == (days(5, 6, 7) if name in anew else days(*range(1, 8)))
    assert all(f"repair of the {sensor}" in rows[name].reason for name in anew)


def test_an_edge_to_the_reference_states_what_its_sensor_states_and_each_thing_once(lake):
    event = ServiceEvent(vehicle="a", day="2026-03-04", sensor="all", kind="repair")
    targets = {"targets_m": np.array([[15.0, 3.0, -2.0], [25.0, -4.0, -2.0], [40.0, 5.0, -2.0]])}
    rows = states(lake, pose_rows("a", 7, np.random.default_rng(4), **targets), [event], edges=EDGES)
    for edge in EDGES:
        row, own = rows[edge.parent.name, edge.child.name], [s for s in edge.sensors if s.name != "top"]
        assert row.reason.count("azimuth not certified") == ("azimuth" not in row.determined)
        if len(own) == 1:
            for name in ("reason", "azimuth_sigma_rad", "elevation_sigma_rad", "determined", "status"):
                assert getattr(row, name) == getattr(rows[own[0].name], name)


@pytest.mark.parametrize(
    ("moved", "edge", "anew"),
    [
        ("left", ("left", "top"), {"left"}),
        ("front", ("front", "bumper"), {"front"}),
        ("top", ("left", "top"), {"front", "left", "bumper", "corner"}),
        (None, ("front", "bumper"), {"front", "bumper"}),
        (None, ("left", "top"), {"front", "left", "bumper", "corner"}),
    ],
)
def test_the_sensor_that_the_audit_found_moved_begins_anew_and_the_others_keep_their_days(
    lake, moved, edge, anew
):
    rows = states(lake, pose_rows("a", 7, np.random.default_rng(5)), (), [found_change(moved, edge)])
    for name in ("front", "left", "bumper", "corner"):
        assert rows[name].days == (days(4, 5, 6, 7) if name in anew else days(*range(1, 8)))
        assert (" moved" in rows[name].reason) == (name in anew)
        assert ("undecided which" in rows[name].reason) == (name in anew and moved is None)


def test_too_few_days_for_a_chart_still_show_a_knock_and_the_state_is_that_of_after_it(lake):
    knocked = pose_rows("a", 5, np.random.default_rng(6), motion=lambda d: {"front": TURN} if d >= 3 else {})
    rows = states(lake, knocked)
    assert rows["front"].days == days(4, 5)
    assert rows["front"].since == "2026-03-04"
    assert "changed on 2026-03-04" in rows["front"].reason
    assert np.abs(error(rows["front"], TURN)).max() < 3
    assert rows["left"].days == days(1, 2, 3, 4, 5)


def test_a_slow_drift_makes_recent_days_weigh_more_and_tomorrow_less_sure(lake):
    drifting = pose_rows("a", 12, np.random.default_rng(12), motion=lambda d: {"front": d * TURN / 10})
    still = states(lake, drifting)["front"]
    found = found_change("front", ("front", "top"), "2026-03-02")
    drift = replace(found, kind="slow drift", magnitude=11 * TURN[1] / 10, day="2026-03-13")
    row = states(lake, drifting, (), [drift])["front"]
    tomorrow = T_TOP["front"] @ exp_se3(12 * TURN / 10)
    lag = [abs(np.degrees(log_se3(inverse(tomorrow) @ transform_of(r))[1])) for r in (still, row)]
    assert lag[1] < lag[0] - 0.01
    assert row.covariance[2, 2] > 1.5 * still.covariance[2, 2]


def test_days_whose_poses_refer_to_another_sensor_are_left_out_and_said(lake):
    rng = np.random.default_rng(8)
    commit_records(lake, POSES, pose_rows("a", 2, rng, reference="bumper"))
    rows = states(lake, [r for r in pose_rows("a", 5, rng) if r.day > "2026-03-02"])
    assert rows["front"].days == days(3, 4, 5)
    assert "refer to another sensor: 2026-03-01, 2026-03-02" in rows["front"].reason
    assert np.abs(error(rows["front"])).max() < 3


def test_a_rig_without_a_lidar_has_a_state_of_radars_too(lake):
    rows = states(lake, pose_rows("a", 3, np.random.default_rng(9), reference="bumper"))
    T = transform_of(rows["corner"])
    assert np.abs(log_se3(T @ inverse(inverse(T_TOP["bumper"]) @ T_TOP["corner"])) / POSE_SIGMA).max() < 3
    assert rows["corner"].parent_frame == "bumper"


def test_a_damaged_pose_is_not_fused(lake):
    of = {(1, "left"): {"covariance": np.full((6, 6), np.nan)}, (2, "front"): {"qw": 3.0}}
    rows = states(lake, pose_rows("a", 4, np.random.default_rng(10), of=of))
    assert rows["left"].days == days(1, 3, 4)
    assert rows["front"].days == days(1, 2, 4)


def test_a_held_day_that_lies_apart_leaves_both_poses_possible(lake):
    """The day of a knock was held: the file of that night was 1 deg off, and certified."""
    of = {(4, "front"): {"status": "held", "reason": "halves of the day disagree"}}
    turn = lambda d: {"front": 2 * TURN * (d >= 4)}  # noqa: E731
    turned = pose_rows("a", 5, np.random.default_rng(13), motion=turn, of=of)
    front = states(lake, turned)["front"]
    assert front.days[-1] == "2026-03-04"
    assert "azimuth" not in front.determined
    assert "2026-03-05 was held and differs" in front.reason
    truth = T_TOP["front"] @ exp_se3(2 * TURN)
    sigma = np.sqrt(np.diag(front.covariance)[:3])
    assert np.all(np.abs(log_se3(transform_of(front) @ inverse(truth))[:3]) < 3 * sigma)


def test_a_day_within_which_the_sensor_moved_leaves_the_state_unsure_until_a_later_day_counts(lake):
    """A camera turned by half a degree at noon: the day was refused, and the state of the days before it certified."""
    moved = {(4, "front"): REFUSED | {"faults": ["moved_in_day"]}}
    night = states(lake, pose_rows("a", 5, np.random.default_rng(14), of=moved))
    assert night["front"].days[-1] == "2026-03-04"
    assert night["front"].determined == []
    assert "moved during 2026-03-05" in night["front"].reason
    assert np.sqrt(np.diag(night["front"].covariance)[:3]).min() > np.radians(0.5)
    assert night["left"].determined == ["azimuth", "elevation"]
    after = states(lake, pose_rows("a", 10, np.random.default_rng(14), of=moved))["front"]
    assert (after.days, after.since) == (days(6, 7, 8, 9, 10), "2026-03-06")  # however small the turn was
    assert after.determined == ["azimuth", "elevation"]

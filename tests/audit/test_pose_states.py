"""One rig per vehicle: what it rests on, how sure it is, and what it says of sensors that it lacks."""

import numpy as np
import pytest

from pipeline.audit.pose_states import pose_states, read_poses
from pipeline.config import VerifyConfig
from pipeline.geometry.se3 import exp_se3, inverse, log_se3
from pipeline.store.commits import commit_records
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake
from schemas.drift import DriftFinding
from schemas.poses import POSES
from schemas.service_events import ServiceEvent
from tests.makers.rig_records import POSE_SIGMA, T_TOP, pose_rows

TURN = np.array([0.0, np.radians(0.5), 0.0, 0.0, 0.0, 0.0])
LAST = "2026-03-30"
REFUSED = {"status": "refused", "reason": "no edge of it can be used", "covariance": None, "qw": None}


@pytest.fixture
def lake(tmp_path):
    return Lake.at(tmp_path / "lake")


def states(lake, rows, events=(), findings=(), scales=None):
    commit_records(lake, POSES, rows)
    poses = read_poses(lake, "joint", "2026-03-01", LAST)
    of_vehicle = pose_states(
        (rows[0].vehicle, LAST, "joint"), poses, (events, findings), scales or {}, VerifyConfig()
    )
    return {row.sensor: row for row in of_vehicle}


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
    # Days that are independent, of which a state takes for granted that they err alike by .6, and no common error.
    assert 1.0 < np.mean(squares) < 6.0


def test_a_sensor_without_an_accepted_day_is_named_with_what_its_last_day_says_and_has_no_pose(lake):
    of = {(k, "left"): REFUSED for k in range(4)}
    rows = states(lake, pose_rows("a", 4, np.random.default_rng(3), of=of))
    left = rows["left"]
    assert (left.status, transform_of(left), left.covariance, left.days) == ("none", None, None, [])
    assert left.reason == "no accepted day; 2026-03-04 refused: no edge of it can be used"
    assert rows["front"].status == "current"


def test_held_days_do_not_count(lake):
    of = {(k, "left"): {"status": "held"} for k in (1, 2)}
    assert states(lake, pose_rows("a", 4, np.random.default_rng(3), of=of))["left"].days == days(1, 4)


@pytest.mark.parametrize(
    ("sensor", "anew"), [("left", {"left"}), ("top", {"front", "left", "bumper", "corner"})]
)
def test_after_a_service_the_sensor_begins_anew_and_with_the_reference_all(lake, sensor, anew):
    event = ServiceEvent(vehicle="a", day="2026-03-04", sensor=sensor, kind="repair")
    rows = states(lake, pose_rows("a", 7, np.random.default_rng(4)), [event])
    for name in ("front", "left", "bumper", "corner"):
        assert rows[name].days == (days(5, 6, 7) if name in anew else days(*range(1, 8)))
    assert all(f"repair of the {sensor}" in rows[name].reason for name in anew)


@pytest.mark.parametrize(
    ("moved", "edge", "anew"),
    [
        ("left", ("left", "top"), {"left"}),
        ("front", ("front", "bumper"), {"front"}),
        ("top", ("left", "top"), {"front", "left", "bumper", "corner"}),
        (None, ("front", "bumper"), {"front", "bumper"}),
        (None, ("left", "top"), {"left"}),
    ],
)
def test_the_sensor_that_the_audit_found_moved_begins_anew_and_the_others_keep_their_days(
    lake, moved, edge, anew
):
    rows = states(lake, pose_rows("a", 7, np.random.default_rng(5)), (), [found_change(moved, edge)])
    for name in ("front", "left", "bumper", "corner"):
        assert rows[name].days == (days(4, 5, 6, 7) if name in anew else days(*range(1, 8)))
        assert ("a change of" in rows[name].reason) == (name in anew)


def test_too_few_days_for_a_chart_still_show_a_knock_and_the_state_is_that_of_after_it(lake):
    knocked = pose_rows("a", 5, np.random.default_rng(6), motion=lambda d: {"front": TURN} if d >= 3 else {})
    rows = states(lake, knocked)
    assert rows["front"].days == days(4, 5)
    assert rows["front"].since == "2026-03-04"
    assert "show another pose since 2026-03-04" in rows["front"].reason
    assert np.abs(error(rows["front"], TURN)).max() < 3
    assert rows["left"].days == days(1, 2, 3, 4, 5)


def test_two_days_that_contradict_each_other_make_a_state_as_unsure_as_that(lake):
    rows = states(lake, pose_rows("a", 2, np.random.default_rng(7), motion=lambda d: {"left": d * TURN}))
    sigma = np.degrees(np.sqrt(np.diag(rows["left"].covariance)[:3]))
    assert sigma.max() > 0.2  # half a degree lies between them
    assert rows["left"].determined != ["azimuth", "elevation"]
    assert "its days differ by more than their sigmas" in rows["left"].reason
    assert rows["front"].reason == ""


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

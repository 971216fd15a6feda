"""Stage lines: from records to what a line shares and to each vehicle's answer, night by night."""

from dataclasses import replace

import numpy as np
import pytest

import pipeline.audit.line_records as line_records_of_audit
from pipeline.audit.line_records import Asked, read_line_records
from pipeline.config import FleetConfig
from pipeline.geometry.changes import change_between, change_covariance
from pipeline.geometry.se3 import exp_se3, from_quaternion, inverse, log_se3
from pipeline.report.lines import shared_words
from pipeline.stage_work import Task, Window
from pipeline.stages import AUDIT, LINES, STATE
from pipeline.store.commits import commit_records
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake, days_after
from pipeline.store.records import read_last, read_records
from schemas.calibrations import CALIBRATIONS
from schemas.fleet_model import FLEET_MODEL, LINE_ANSWERS, FleetModelRow, LineAnswer
from schemas.poses import POSES
from schemas.radar_alignments import RADAR_ALIGNMENTS, RadarAlignment
from schemas.states import STATES, StateRow
from schemas.versions import CODE_VERSION
from tests.makers.fleet_lakes import one_rig_fleet
from tests.makers.line_records import DEG, MadeLine, change_of, line_records
from tests.makers.rig_records import T_TOP, pose_rows, rig_records


def fleet_of(**sections):
    return FleetConfig.model_validate(
        one_rig_fleet().model_dump(exclude_defaults=True) | {"vehicles": {"*": {"rig": "default"}}} | sections
    )


def lines(lake, fleet, last=None):
    """The audit and the lines of a night: (rows of lines, answers by vehicle and pair)."""
    task = Task(fleet, lake, Window(None, last))
    AUDIT.run(task)
    LINES.run(task)
    answers = {(a.vehicle, a.pair): a for a in read_last(lake, LINE_ANSWERS, LineAnswer, "joint")}
    day = next(iter(answers.values())).day
    rows = read_records(lake, FLEET_MODEL, FleetModelRow, day=day)
    return {r.pair: r for r in rows}, answers


def night(folder, line, **sections):
    lake = Lake.at(folder)
    commit_records(lake, CALIBRATIONS, line_records(line))
    return lines(lake, fleet_of(**sections))


def errors(line, answers, pair, of="answer"):
    """Errors of answers as changes, and their sigmas."""
    mounts, off, sigma = line.mounts()[pair], [], []
    for v in range(line.vehicles):
        answer = answers[line.vehicle(v), pair]
        T = transform_of(answer)
        found = change_of(T, pair)
        covariance = answer.covariance
        if of == "alone":
            found, covariance = found - answer.moved_by, answer.alone_covariance
        if of == "record":
            found, covariance = found + answer.record_change, answer.record_covariance
        off.append(found - mounts[v] - line.bias.get(pair, 0.0))
        sigma.append(np.sqrt(np.diag(change_covariance(T, covariance))))
    return np.array(off), np.array(sigma)


def test_equal_mounts_make_a_day_of_few_frames_surer_and_the_sigmas_hold(tmp_path):
    line = MadeLine(60, 3, seed=1)
    rows, answers = night(tmp_path, line)
    assert {r.status for r in rows.values()} == {"GREEN"}
    for pair, axes in (("camera_lidar", [0, 1, 2]), ("lidar_radar", [1, 2])):
        off, sigma = errors(line, answers, pair)
        alone, alone_sigma = errors(line, answers, pair, "alone")
        z = (off / sigma)[:, axes]
        assert np.mean(np.abs(z) < 3) > 0.99
        assert np.sqrt(np.mean(alone[:, axes] ** 2)) > np.sqrt(np.mean(off[:, axes] ** 2))
        # A vehicle that the line may not move as far as it would is less sure than alone: few of them.
        assert np.mean((sigma <= alone_sigma * 1.001)[:, axes]) > 0.9
        assert rows[pair].most_without_one < 0.2
    off, sigma = errors(line, answers, "lidar_radar", "record")
    alone = np.sqrt(
        [np.diag(answers[line.vehicle(v), "lidar_radar"].record_alone_covariance)[1] for v in range(60)]
    )
    assert np.median(sigma[:, 1]) < 0.6 * np.median(alone)
    assert np.mean(np.abs(off / sigma)[:, 1] < 3) > 0.98


def stamped(records):
    """Records that were asserted in the night after their day."""
    stamp = {r.day: f"{days_after(r.day, 1)}T02:00:00.000000Z" for r in records}
    return [replace(r, recorded_at=stamp[r.day], asserted_at=stamp[r.day]) for r in records]


def by_night(lake, records, fleet, **of_night):
    """The last night of nights that each commit their day; `of_night`: fleets of some of them, by number."""
    found = {}
    for k, last in enumerate(sorted({r.day for r in records})):
        commit_records(lake, CALIBRATIONS, [r for r in records if r.day == last])
        found = lines(lake, of_night.get(f"night_{k}", fleet), last)
    return found


def at_once(lake, records, fleet):
    commit_records(lake, CALIBRATIONS, records)
    return lines(lake, fleet)


def largest_difference(some, others):
    """Of answers with the same keys, in sigmas of their axes."""
    assert some.keys() == others.keys()
    return max(
        np.abs(
            change_between(transform_of(a), transform_of(others[key]))
            / np.sqrt(np.diag(change_covariance(transform_of(a), a.covariance)))
        ).max()
        for key, a in some.items()
    )


@pytest.mark.slow
@pytest.mark.parametrize("is_stamped", [True, False])
def test_a_night_that_adds_its_day_counts_what_all_days_at_once_do(tmp_path, is_stamped):
    line, fleet = MadeLine(12, 6, seed=2), fleet_of()
    records = stamped(line_records(line)) if is_stamped else line_records(line)
    _, nights = by_night(Lake.at(tmp_path / "nights"), records, fleet)
    _, whole = at_once(Lake.at(tmp_path / "at-once"), records, fleet)
    assert largest_difference(nights, whole) < 0.005
    for key, answer in whole.items():
        other = nights[key]
        np.testing.assert_allclose(other.sums, answer.sums, rtol=2e-3, atol=1e-6 * np.abs(answer.sums).max())
        assert (other.days, other.first_day, other.last_day) == (
            pytest.approx(answer.days), answer.first_day, answer.last_day,
        )  # fmt: skip


def test_a_night_without_anything_new_has_the_same_rows_to_the_last_bit(tmp_path):
    records = stamped(line_records(MadeLine(8, 3, seed=42)))
    lake, fleet = Lake.at(tmp_path), fleet_of()
    _, first = at_once(lake, records, fleet)
    _, again = lines(lake, fleet)
    assert {k: a.work_key for k, a in first.items()} == {k: a.work_key for k, a in again.items()}


@pytest.mark.parametrize("most", [50, 10])
def test_records_are_read_in_parts_that_memory_holds_and_count_as_all_at_once_do(tmp_path, monkeypatch, most):
    line, fleet = MadeLine(12, 5, seed=52), fleet_of()
    _, whole = at_once(Lake.at(tmp_path / "whole"), line_records(line), fleet)
    monkeypatch.setattr(line_records_of_audit, "_AT_A_TIME", most)
    lake = Lake.at(tmp_path / "parts")
    _, answers = at_once(lake, line_records(line), fleet)
    assert largest_difference(answers, whole) < 0.005
    days = sorted({r.day for r in line_records(line)})
    parts = list(read_line_records(lake, days[0], days[-1], Asked("joint", days[-1])))
    sizes = [len(part.records.day) for part in parts]
    assert sum(sizes) == 12 * 5 * 2
    assert max(sizes) <= most
    seen = [part.records.day.max() for part in parts]
    assert seen == sorted(seen), "days come in order, as sums need them"


def test_a_vehicle_that_one_night_did_not_know_counts_with_all_of_its_days(tmp_path):
    line, fleet = MadeLine(8, 5, seed=34), fleet_of()
    records = stamped(line_records(line))
    seven = {f"car-000{k}": {"rig": "default"} for k in range(7)}
    fewer = fleet_of(vehicles=seven)
    _, nights = by_night(Lake.at(tmp_path / "nights"), records, fleet, night_3=fewer)
    assert nights["car-0007", "camera_lidar"].days == pytest.approx(nights["car-0000", "camera_lidar"].days)
    _, whole = at_once(Lake.at(tmp_path / "at-once"), records, fleet)
    assert largest_difference(nights, whole) < 0.005


def test_a_vehicle_whose_last_day_lies_elsewhere_answers_as_alone_and_says_so(tmp_path):
    knock = {"lidar_radar": np.array([0, 0, 1.5 * DEG, 0, 0, 0])}
    line = MadeLine(
        20, 8, seed=35, pairs=("lidar_radar",), motion=lambda v, d: knock if (v, d) == (7, 7) else {}
    )
    lake, fleet = Lake.at(tmp_path), fleet_of(fleet_model={"use": "states"})
    _, answers = at_once(lake, line_records(line), fleet)
    answer = answers["car-0007", "lidar_radar"]
    assert (answer.status, answer.away) == ("outside", 1)
    assert "left out of its answer: its last day lies far from the others" in answer.reason
    STATE.run(Task(fleet, lake, Window()))
    states = {r.vehicle: r for r in read_last(lake, STATES, StateRow, "joint")}
    assert (states["car-0007"].loads, states["car-0007"].status) == ("alone", "none")
    assert states["car-0006"].loads == "line"


def test_a_vehicle_with_a_wide_prior_stays_unsure_where_its_days_are_silent_though_its_line_has_a_narrow_one(
    tmp_path,
):
    wide, narrow = MadeLine(6, 2, seed=36), MadeLine(10, 2, seed=37, name="van")
    # A prior of a tenth of a degree and 5 mm: what days leave open stays as sure as that.
    sure = np.array([0.1 * DEG] * 3 + [0.005] * 3)
    records = line_records(wide) + line_records(replace(narrow, prior=sure))
    rows, answers = at_once(
        Lake.at(tmp_path), records, fleet_of(vehicles={"*": {"rig": "default", "model": "all"}})
    )
    roll = {v: np.sqrt(a.covariance[0, 0]) / DEG for (v, pair), a in answers.items() if pair == "lidar_radar"}
    assert 1.9 < roll["car-0001"] < 3.0
    assert roll["van-0001"] < 0.3
    assert "priors of its vehicles differ" in rows["lidar_radar"].reason


def test_one_vehicle_that_states_a_wide_common_error_widens_nobody_else_s_answer(tmp_path):
    records = line_records(MadeLine(12, 3, seed=38))
    wide = [
        replace(
            r,
            covariance=r.covariance + 399 * r.common_covariance,
            common_covariance=400 * r.common_covariance,
        )
        if r.vehicle == "car-0007"
        else r
        for r in records
    ]
    (_, before), (_, after) = (
        at_once(Lake.at(tmp_path / name), own, fleet_of()) for name, own in (("a", records), ("b", wide))
    )
    for pair in ("camera_lidar", "lidar_radar"):
        ratio = after["car-0001", pair].elevation_sigma_rad / before["car-0001", pair].elevation_sigma_rad
        assert 0.8 < ratio < 1.25


@pytest.mark.parametrize(
    "damage",
    [
        {"prior_covariance": np.diag([0.0, 1, 1, 1, 1, 1])},
        {"prior_qw": 0.0, "prior_qx": 0.0, "prior_qy": 0.0, "prior_qz": 0.0},
        {"prior_qw": float("nan")},
        {"covariance": np.ones((6, 6))},
        {"pair": "camera_sonar"},
    ],
)
def test_a_record_that_cannot_be_counted_costs_the_others_nothing(tmp_path, damage):
    records = line_records(MadeLine(8, 2, seed=39))
    bad = records[3]
    lake = Lake.at(tmp_path)
    commit_records(lake, CALIBRATIONS, [replace(r, **damage) if r is bad else r for r in records])
    rows, answers = lines(lake, fleet_of())
    assert rows["camera_lidar"].status == "GREEN"
    assert len([a for a in answers.values() if a.days > 1.5]) == 15


@pytest.mark.slow
def test_nights_of_a_hundred_days_count_nearly_what_all_at_once_do(tmp_path):
    records = stamped(line_records(MadeLine(6, 100, seed=40, pairs=("camera_lidar",))))
    lake = Lake.at(tmp_path / "nights")
    days = sorted({r.day for r in records})
    for last in (days[49], days[74], days[99]):
        commit_records(lake, CALIBRATIONS, [r for r in records if r.day <= last])
        _, nights = lines(lake, fleet_of(), last)
    _, whole = at_once(Lake.at(tmp_path / "at-once"), records, fleet_of())
    assert (
        nights["car-0001", "camera_lidar"].first_day == whole["car-0001", "camera_lidar"].first_day == days[0]
    )
    assert largest_difference(nights, whole) < 0.02


def test_days_that_were_recorded_before_an_audit_of_an_earlier_window_are_counted_after_it(tmp_path):
    line, fleet = MadeLine(8, 6, seed=14), fleet_of()
    records, lake = line_records(line), Lake.at(tmp_path)
    days = sorted({r.day for r in records})
    # The later days were recorded first, each day at a time of its own.
    order = [days.index(d) for d in (*days[3:], *days[:3])]
    stamp = {days[k]: f"2026-03-{20 + n}T00:00:00.000000Z" for n, k in enumerate(order)}
    records = [replace(r, recorded_at=stamp[r.day], asserted_at=stamp[r.day]) for r in records]
    commit_records(lake, CALIBRATIONS, records)
    lines(lake, fleet, days[2])
    answer = lines(lake, fleet)[1][line.vehicle(0), "camera_lidar"]
    assert answer.last_day == days[-1]
    assert answer.days == pytest.approx(6, abs=0.5)


def test_a_record_of_a_day_that_is_counted_already_is_counted_once_and_as_it_is_now(tmp_path):
    line, fleet = MadeLine(8, 3, seed=3), fleet_of()
    records, lake = line_records(line), Lake.at(tmp_path)
    commit_records(lake, CALIBRATIONS, records)
    before = lines(lake, fleet)[1]
    assert (
        lines(lake, fleet)[1][line.vehicle(0), "camera_lidar"].days
        == before[line.vehicle(0), "camera_lidar"].days
    )
    again = [
        replace(r, work_key=f"{r.work_key}-again", status="refused")
        for r in records
        if r.vehicle == line.vehicle(0)
    ]
    commit_records(lake, CALIBRATIONS, [r for r in again if r.day == "2026-03-02"])
    after = lines(lake, fleet)[1]
    assert after[line.vehicle(0), "camera_lidar"].days == pytest.approx(2, abs=0.1)
    assert after[line.vehicle(1), "camera_lidar"].days == before[line.vehicle(1), "camera_lidar"].days


def test_a_vehicle_outside_its_line_is_named_on_its_first_day_and_answers_as_alone(tmp_path):
    knock = np.array([0, 0, 1.5 * DEG, 0, 0, 0])
    line = MadeLine(40, 1, seed=4, motion=lambda v, _: {"lidar_radar": knock} if v == 7 else {})
    rows, answers = night(tmp_path, line)
    assert rows["lidar_radar"].outside == [line.vehicle(7)]
    answer = answers[line.vehicle(7), "lidar_radar"]
    assert (answer.status, answer.differs, answer.distance_axis) == ("outside", True, "rz")
    np.testing.assert_allclose(answer.moved_by, 0.0, atol=1e-12)
    np.testing.assert_allclose(answer.covariance, answer.alone_covariance, rtol=1e-6)


def test_a_shared_error_is_stated_and_nobody_s_certainty_rests_on_it(tmp_path):
    bias = np.array([0, 0.8 * DEG, 0, -0.1, 0, 0])
    line = MadeLine(50, 5, seed=5, bias={"lidar_radar": bias})
    rows, answers = night(tmp_path, line)
    row = rows["lidar_radar"]
    assert row.told_apart == []
    assert row.totals["radar elevation"] == pytest.approx(0.8 * DEG, rel=0.15)
    assert row.totals["radar range"] == pytest.approx(0.1, rel=0.15)
    _, sigma = errors(line, answers, "lidar_radar")
    assert (sigma[:, 1] > 0.19 * DEG).all()  # the common part of its records


def test_a_line_of_which_half_drifts_together_is_red_and_has_no_part_in_answers(tmp_path):
    drift = np.array([0, 0, 0.3 * DEG, 0, 0, 0])
    line = MadeLine(
        40, 12, seed=6, motion=lambda v, d: {"camera_lidar": drift * max(d - 5, 0)} if v % 2 else {}
    )
    rows, answers = night(tmp_path, line)
    assert rows["camera_lidar"].status == "RED"
    assert "of 40 vehicles" in rows["camera_lidar"].reason
    assert {a.status for (_, pair), a in answers.items() if pair == "camera_lidar"} == {"alone"}


def test_five_vehicles_are_no_line_and_the_row_says_how_many_are_needed(tmp_path):
    rows, answers = night(tmp_path, MadeLine(5, 2, seed=7))
    assert rows["camera_lidar"].status == "UNKNOWN"
    assert rows["camera_lidar"].reason == "5 vehicles with days, 6 needed"
    assert {a.status for a in answers.values()} == {"alone"}


def test_lines_of_two_models_share_nothing_with_each_other(tmp_path):
    bias = np.array([0, 1.0 * DEG, 0, 0, 0, 0])
    lake = Lake.at(tmp_path)
    a, b = MadeLine(8, 8, seed=8), MadeLine(9, 8, seed=9, name="van", bias={"lidar_radar": bias})
    commit_records(lake, CALIBRATIONS, [*line_records(a), *line_records(b)])
    vehicles = {"car-*": {"rig": "default"}, "van-*": {"rig": "default", "model": "van"}}
    task = Task(fleet_of(vehicles=vehicles), lake, Window())
    AUDIT.run(task)
    LINES.run(task)
    rows = read_records(lake, FLEET_MODEL, FleetModelRow)
    assert {(r.line, r.pair): r.vehicles for r in rows} == {
        (line, pair): count for line, count in (("default", 8), ("van", 9)) for pair in ("camera_lidar", "lidar_radar")
    }  # fmt: skip
    total = {r.line: r.totals.get("radar elevation") for r in rows if r.pair == "lidar_radar"}
    assert total["van"] - total["default"] == pytest.approx(1.0 * DEG, abs=0.4 * DEG)


def test_states_load_the_answer_with_the_line_where_fleet_toml_asks_for_it(tmp_path):
    line = MadeLine(30, 3, seed=10)
    lake = Lake.at(tmp_path)
    commit_records(lake, CALIBRATIONS, line_records(line))
    for use in ("report", "states"):
        fleet = fleet_of(fleet_model={"use": use})
        _, answers = lines(lake, fleet)
        state = {(s.vehicle, s.pair): s for s in STATE.run(Task(fleet, lake, Window())).records}
        own = state[line.vehicle(3), "lidar_radar"]
        answer = answers[line.vehicle(3), "lidar_radar"]
        assert own.line_status == "shared"
        np.testing.assert_allclose(own.line_covariance, answer.covariance)
        if use == "report":
            assert own.status == "none"  # no day of it was accepted
        else:
            assert own.status == "current"
            np.testing.assert_allclose(transform_of(own), transform_of(answer), atol=1e-9)


def test_mounts_scatter_by_what_they_do_though_few_days_hardly_tell_how_alike_days_err(tmp_path):
    rows, _ = night(tmp_path, MadeLine(80, 4, seed=11, scatter=np.array([0.2 * DEG] * 3 + [0.005] * 3)))
    found = np.degrees(rows["camera_lidar"].scatter[:3])
    assert (np.abs(found - 0.2) < 0.06).all()
    assert np.isnan(rows["lidar_radar"].scatter[0])  # roll of the radar: no vehicle determines it


@pytest.mark.parametrize("pair", ["radar_base", "lidar_radar"])
def test_radars_that_report_their_mount_in_the_vehicle_tell_a_shared_error_there_and_not_on_other_edges(
    tmp_path, pair
):
    sign = -1 if pair == "radar_base" else 1  # what a parent measures wrongly shows as it is
    bias = {pair: np.array([0, sign * 0.8 * DEG, 0, 0, 0, 0])}
    line, lake = MadeLine(40, 5, seed=12, bias=bias, pairs=(pair,)), Lake.at(tmp_path)
    commit_records(lake, CALIBRATIONS, line_records(line))
    turned_up = -sign * line.mounts()[pair][:, 1]
    rows = [
        RadarAlignment(
            vehicle=line.vehicle(v), day="2026-03-05", method="joint", sensor="radar", topics=["/alignment"],
            sign_is_published=True, messages=9, first_stamp_ns=0, last_stamp_ns=1, own_edge="lidar-radar",
            elevation_rad=float(turned_up[v]), elevation_sigma_rad=0.1 * DEG, work_key=f"a{v}",
        )
        for v in range(line.vehicles)
    ]  # fmt: skip
    commit_records(lake, RADAR_ALIGNMENTS, rows)
    row = lines(lake, fleet_of())[0][pair]
    assert row.totals["radar elevation"] == pytest.approx(0.8 * DEG, rel=0.2)
    if pair == "radar_base":
        assert row.told_apart == ["radar elevation"]
        assert row.shared_errors["radar elevation"] == pytest.approx(0.8 * DEG, rel=0.15)
    else:  # the lidar may be mounted otherwise on all vehicles
        assert row.told_apart == []


MOUNTS = np.r_[np.radians([0.02] * 3), 0.004, 0.004, 0.004]


def rigs(lake, vehicles, days, *, version=CODE_VERSION, moved=None):
    """Records of rigs with five sensors whose mounts hardly differ: motion of each sensor by vehicle."""
    motions = {}
    for v in range(vehicles):
        rng = np.random.default_rng([7, v])
        motion = {s: MOUNTS * rng.normal(size=6) for s in ("front", "left", "bumper", "corner")}
        motion |= (moved or {}).get(v, {})
        name = f"v{v:02d}"
        motions[name] = motion
        edges = rig_records(name, days, rng, motion=lambda _, m=motion: m)
        made_by = {"code_version": version, "work_key": f"{name} {version}"}
        commit_records(lake, CALIBRATIONS, [replace(r, **made_by) for r in edges])
        commit_records(
            lake, POSES, pose_rows(name, days, rng, motion=lambda _, m=motion: m, code_version=version)
        )
    return motions


def pose_states_of(lake, **sections):
    """States of sensors by vehicle and sensor, after a night."""
    lines(lake, fleet_of(**sections))
    STATE.run(Task(fleet_of(**sections), lake, Window()))
    return {(r.vehicle, r.sensor): r for r in read_last(lake, STATES, StateRow, "joint") if r.sensor}


@pytest.mark.slow
def test_poses_of_a_rig_are_surer_with_their_line_and_a_knocked_camera_keeps_its_own(tmp_path):
    lake = Lake.at(tmp_path)
    knock = {3: {"front": np.r_[0, np.radians(1.0), 0, 0, 0, 0]}}
    motions = rigs(lake, 20, 2, moved=knock)
    states = pose_states_of(lake, fleet_model={"use": "states"})
    squares, sigmas, alone = [], [], []
    for (vehicle, sensor), row in states.items():
        if sensor == "top":
            assert row.line_status is None
            continue
        is_knocked = (vehicle, sensor) == ("v03", "front")
        assert (row.loads, row.line_status) == (("alone", "outside") if is_knocked else ("line", "shared"))
        true = T_TOP[sensor] @ exp_se3(motions[vehicle][sensor])
        off = log_se3(transform_of(row) @ inverse(true))
        squares.append(off @ np.linalg.solve(row.covariance, off))
        if not is_knocked:
            sigmas.append(np.sqrt(np.diag(row.covariance)))
            alone.append(np.sqrt(np.diag(row.alone_covariance)))
            assert "with default, its model line" in row.reason
    assert np.median(sigmas, axis=0)[:3] == pytest.approx(0.7 * np.median(alone, axis=0)[:3], rel=0.25)
    assert 1.0 < np.mean(squares) < 9.0
    assert max(squares) < 30.0  # six axes: beyond it one in 25,000


def test_a_drawing_of_a_pose_has_kinds_and_its_edge_between_the_same_sensors_is_another_row(tmp_path):
    lake = Lake.at(tmp_path)
    rigs(lake, 6, 1)
    lines(lake, fleet_of())
    rows = {
        (r.pair, r.parent_frame, r.child_frame): r
        for r in read_last(lake, FLEET_MODEL, FleetModelRow, "joint")
    }
    pose, edge = rows["pose", "top", "front"], rows["camera_lidar", "front", "top"]
    assert (pose.kinds, edge.kinds) == ("lidar_camera", "camera_lidar")
    np.testing.assert_allclose(drawing_of(pose), inverse(drawing_of(edge)), atol=2e-3)
    assert {name for pair, _, name in rows if pair == "pose"} == {"front", "left", "bumper", "corner"}


def test_records_of_another_release_do_not_count_and_the_row_names_it(tmp_path):
    lake = Lake.at(tmp_path)
    rigs(lake, 6, 3, version="0.9.0")
    rigs(lake, 6, 1)
    rows, answers = lines(lake, fleet_of())
    row = rows["camera_lidar"]
    assert row.other_releases == ["0.9 until 2026-03-03"]
    assert row.reason == "records of release 0.9 until 2026-03-03 do not count"
    assert {a.days for a in answers.values()} == {1.0}


def test_a_vehicle_whose_line_changes_counts_with_the_new_one_and_says_which_it_had(tmp_path):
    line = MadeLine(8, 2, seed=31)
    lake = Lake.at(tmp_path)
    commit_records(lake, CALIBRATIONS, line_records(line))
    lines(lake, fleet_of())
    vehicles = {"car-0003": {"rig": "default", "model": "long"}, "*": {"rig": "default"}}
    _, answers = lines(lake, fleet_of(vehicles=vehicles))
    answer = answers["car-0003", "camera_lidar"]
    assert (answer.line, answer.days) == ("long", pytest.approx(2.0, rel=0.05))
    assert answer.reason.startswith("its line was default until now: all of its days count with long")
    assert answers["car-0004", "camera_lidar"].reason == ""


@pytest.mark.parametrize(
    ("last", "version", "words"),
    [
        ("2026-03-04", CODE_VERSION, "model lines were learnt for 2026-03-02, not for 2026-03-04"),
        ("2026-03-02", "0.9.0", "model lines were learnt by boresight 0.9.0"),
    ],
)
def test_states_refuse_lines_of_another_day_or_release_and_say_so(
    tmp_path, monkeypatch, last, version, words
):
    line, lake = MadeLine(8, 4, seed=32), Lake.at(tmp_path)
    fleet = fleet_of(fleet_model={"use": "states"})
    commit_records(lake, CALIBRATIONS, [replace(r, status="accepted", reason="") for r in line_records(line)])
    monkeypatch.setattr("pipeline.audit.line_stage.CODE_VERSION", version)
    lines(lake, fleet, "2026-03-02")
    STATE.run(Task(fleet, lake, Window(None, last)))
    rows = read_last(lake, STATES, StateRow, "joint")
    assert {(r.loads, r.line_status, r.status) for r in rows} == {("alone", "alone", "current")}
    assert all(f"loads the vehicle alone: {words}" in r.reason for r in rows)


def test_offsets_of_a_line_and_a_vehicle_that_differs_stand_in_its_row(tmp_path):
    line, lake = MadeLine(10, 5, seed=33), Lake.at(tmp_path)
    rng = np.random.default_rng(33)
    records = [
        replace(
            r,
            time_offset_s=0.02 + 0.002 * rng.normal() + 0.03 * (r.vehicle == "car-0004"),
            time_offset_sigma_s=0.002,
        )
        for r in line_records(line)
    ]
    commit_records(lake, CALIBRATIONS, records)
    rows, _ = lines(lake, fleet_of())
    row = rows["camera_lidar"]
    assert abs(row.clock_mean_s - 0.02) < 4 * row.clock_sigma_s
    assert (row.clock_outside, row.clock_step_s) == (["car-0004"], None)
    assert f"stamps of camera minus lidar {row.clock_mean_s:+.4f}" in " ".join(shared_words(vars(row)))


def drawing_of(row):
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    pose = np.array([getattr(row, f"drawing_{n}") for n in names])
    return from_quaternion(pose[:4], pose[4:])

"""Focal length and principal point by the day: measured where they are wrong, told, and silent where they are right."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.estimate import align_camera_lidar
from pipeline.calibrate.joint.camera_lidar.intrinsics import DayIntrinsics, contradictions
from pipeline.calibrate.joint.solve import solve_joint
from pipeline.core.config import SolveConfig
from pipeline.core.rigs import CameraPrior
from pipeline.rig.cameras import camera_of
from pipeline.rig.se3 import exp_so3
from schemas.calibrations import PAIRS
from tests.makers.camera_lidar import prior_off_by
from tests.makers.traced_scenes import DENSE, traced_day

FOCAL, CENTRE = "focal length is contradicted", "principal point is contradicted"


def wrong(day, factor=1.0, right_px=0.0, down_px=0.0):
    """The day with a CameraInfo whose focal length and principal point are wrong."""
    K = day[0].camera_K.copy()
    K[[0, 1], [0, 1]] *= factor
    K[:2, 2] += right_px, down_px
    return [replace(o, camera_K=K) for o in day]


PRIOR = prior_off_by(1.0, 0.03)


def day():
    return traced_day(DENSE, 9, seed=1, dt_s=0.02)


@cache
def measured(factor=1.0, right_px=0.0, down_px=0.0, *, has_tracks=False):
    rows = wrong(tracked(day()) if has_tracks else day(), factor, right_px, down_px)
    return align_camera_lidar(rows, PRIOR, SolveConfig(), np.random.default_rng(0)).intrinsics


def test_right_intrinsics_are_found_right_and_alarm_nobody():
    found = measured()
    assert found.halves == ()
    assert abs(found.focal - 1) < 2.5 * found.focal_sigma
    assert (np.abs(found.centre_px) < 2.5 * found.centre_sigma_px).all()
    assert contradictions(found, CameraPrior()) == []


def test_a_focal_length_that_is_three_percent_off_is_measured_by_the_day_and_by_its_halves_and_told():
    found = measured(0.97)
    assert found.focal == pytest.approx(1 / 0.97, abs=0.008)
    assert min(half.focal for half in found.halves) > 1.015
    (told,) = [c.sentence for c in contradictions(found, CameraPrior()) if FOCAL in c.sentence]
    assert f"{found.focal - 1:+.1%}" in told


def test_a_principal_point_that_is_wrong_downwards_is_measured_to_its_sigma():
    found = measured(down_px=30.0)
    moved = found.centre_px - measured().centre_px
    assert moved[1] == pytest.approx(-30.0, abs=2 * found.centre_sigma_px[1])
    assert moved[1] < -10.0


def tracked(rows):
    """The rows with tracks of static points between two images, 2 m apart, each with a turn of its own."""
    rng, camera, found = np.random.default_rng(1), camera_of(rows[0]), []
    for o in rows:
        turn, way = rng.normal(0, 0.02, 3), np.append(rng.normal(0, 0.05, 2), 1.0)
        uv = rng.uniform(0, [900, 400], (400, 2))
        now = camera.unproject(uv) * rng.uniform(4, 40, (400, 1))
        before, _ = camera.project(now @ exp_so3(turn).T + 2 * exp_so3(turn / 2) @ way)
        px = (np.hstack([before, uv]) + rng.normal(0, 0.15, (400, 4)))[camera.contains(before)]
        motion = {"motion_turn_rad": turn, "motion_direction": way, "motion_span_s": 0.2}
        found.append(replace(o, motion_tracks_px=px.astype(np.float32), **motion))
    return found


def test_tracks_show_a_principal_point_of_a_fisheye_that_edges_leave_open_as_a_turn_of_the_pose():
    found, by_edges = measured(has_tracks=True), measured()
    assert found.focal == by_edges.focal
    assert np.abs(found.centre_px[0]) < 2.5 * found.centre_sigma_px[0] < 0.6 * by_edges.centre_sigma_px[0]
    assert [contradictions(d, CameraPrior()) for d in (found, measured(right_px=40.0))] == [[], []]
    found = measured(right_px=40.0, has_tracks=True)
    assert found.centre_px[0] == pytest.approx(-40.0, abs=2.5 * found.centre_sigma_px[0])
    (check,) = contradictions(found, CameraPrior())
    assert (CENTRE in check.sentence, check.fault) == (True, "camera_info")
    assert check.error[1] == pytest.approx(np.abs(found.centre_px[0]) / 600)  # by so much the pose is turned


def test_a_contradicted_camera_info_holds_camera_lidar_with_the_measured_value():
    for rows, is_told in ((day(), False), (wrong(day(), 0.97), True)):
        observations = dict.fromkeys(PAIRS, rows)
        solution = solve_joint(observations, PRIOR, SolveConfig(), seed=0, triggered=["camera_lidar"])
        found = solution.failed_checks.get("camera_lidar", [])
        assert any(FOCAL in check.sentence for check in found) == is_told
        d = solution.pairs["camera_lidar"].diagnostics
        assert (d["day_focal_scale"] > 1.02) == is_told
        # What the principal point leaves open in the mounting: nobody stated it, so what the day measured.
        yaw_px = d["mounting_yaw_sigma_rad"] * rows[0].camera_K[0, 0]
        assert yaw_px == pytest.approx(d["day_centre_u_sigma_px"])
        assert any("CameraInfo's principal point" in note for note in solution.pairs["camera_lidar"].notes)


def day_of(focal=1.0, focal_sigma=0.004, centre_px=(0.0, 0.0), centre_sigma_px=(20.0, 3.0)):
    return DayIntrinsics(focal, focal_sigma, np.array(centre_px), np.array(centre_sigma_px), (900.0, 900.0))


def test_contradictions_need_three_sigmas_of_day_and_camera_info_together():
    known = CameraPrior(focal_sigma=0.003, centre_sigma_px=4.0)  # sigmas of both together: 0.5 % and 5 px
    assert contradictions(day_of(1.0149, centre_px=(60.0, 14.9)), known) == []
    (told,) = contradictions(day_of(0.9849), known)
    assert FOCAL in told.sentence
    assert told.error is None  # a wrong focal length always holds
    (told,) = contradictions(day_of(centre_px=(0.0, -15.1)), known)
    assert CENTRE in told.sentence
    assert "-15.1 +- 3.0 px down" in told.sentence
    assert len(contradictions(day_of(1.0149, centre_px=(0.0, 14.9)), CameraPrior(0.0, 0.0, 0.0))) == 2


def test_what_one_half_of_the_frames_does_not_show_is_no_contradiction():
    known, whole = CameraPrior(0.0, 0.0, 0.0), day_of(1.02, centre_px=(0.0, -12.0))
    agree = (day_of(1.025, 0.006, (0.0, -14.0)), day_of(1.015, 0.006, (0.0, -10.0)))
    assert len(contradictions(replace(whole, halves=agree), known)) == 2
    for silent in (day_of(1.011, 0.006, (0.0, -5.0)), day_of(0.98, centre_px=(0.0, 12.0))):
        assert contradictions(replace(whole, halves=(agree[0], silent)), known) == []


def test_diagnostics_say_what_the_day_determined_and_what_stays_open_in_the_mounting():
    known = CameraPrior(focal_sigma=0.003, centre_sigma_px=4.0, centre_is_stated=True)
    d = day_of(1.01, 0.002, (5.0, -2.0)).diagnostics(known)
    assert [d[f"day_{n}_observable"] for n in ("focal", "centre_u", "centre_v")] == [1, 0, 1]
    assert (d["day_centre_u_px"], d["day_centre_v_px"]) == (5.0, -2.0)
    assert d["mounting_pitch_sigma_rad"] == pytest.approx(2.4 / 900)  # 3 px and 4 px together
    assert day_of().diagnostics(CameraPrior())["mounting_yaw_sigma_rad"] == pytest.approx(20 / 900)
    sure = day_of().diagnostics(CameraPrior(centre_sigma_px=0.0, centre_is_stated=True))
    assert sure["mounting_yaw_sigma_rad"] == 0.0

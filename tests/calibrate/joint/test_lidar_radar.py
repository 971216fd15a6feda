"""Lidar-radar of method `joint` on streets with known truth: basin, time offset, honest sigmas, faults."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.calibrate.joint.solve import estimate_camera_radar
from pipeline.calibrate.verify.day_checks import MOVED_SIGMAS, PART_FLOOR_RAD
from pipeline.core.config import SolveConfig
from pipeline.core.errors import SolveError
from pipeline.objective.radar.moving_clusters import camera_radar_cost
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import (
    change_between,
    change_covariance,
    changed,
    exp_se3,
    exp_so3,
    from_spherical,
    log_se3,
    perturb_exactly,
    to_spherical,
)
from tests.makers.radar_errors import bounced, elevated
from tests.makers.radar_scenes import DT_S, GROUND_M, T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR

CONFIG = SolveConfig()
SIGMA_ROTATION = np.radians(2.0)
SIGMA_SHIFT = 0.05


def prior_off_by(rotation_deg, shift_m, seed=0):
    rng = np.random.default_rng(seed)
    T = perturb_exactly(T_LIDAR_RADAR, np.radians(rotation_deg), shift_m, rng)
    return Prior(T_CAMERA_LIDAR, T, SIGMA_ROTATION, SIGMA_SHIFT)


def solve(day, prior, seed=0):
    return estimate_lidar_radar(day, prior, CONFIG, np.random.default_rng(seed))


def error_of(estimate):
    return log_se3(estimate.T @ np.linalg.inv(T_LIDAR_RADAR))


def assert_kept(found, prior):
    """What was not determined is the prior's, to the last digit: rotation vector, position and their sigmas."""
    held = ~found.observable
    moved = change_between(prior.T_lidar_radar, found.T)
    sigma = np.sqrt(np.diag(change_covariance(found.T, found.covariance)))
    before = np.sqrt(np.diag(prior.covariance("lidar_radar")))
    assert np.allclose(moved[held], 0, atol=1e-9)
    assert np.allclose(sigma[held], before[held], rtol=1e-6)
    assert np.all(sigma <= before * (1 + 1e-6))


@pytest.fixture(scope="module")
def day():
    return street_day(40)


@pytest.fixture(scope="module")
def found(day):
    """What half of the day shows from a prior near by."""
    return solve(day[:20], prior_off_by(1, 0.02))


def sigma_of(estimate):
    return np.sqrt(np.diag(estimate.covariance))


@pytest.mark.slow
@pytest.mark.parametrize(("rotation_deg", "shift_m"), [(2, 0.1), (5, 0.3), (10, 0.3)])
def test_wrong_priors_lead_to_the_truth(day, rotation_deg, shift_m):
    for seed in range(2):
        found = solve(day, prior_off_by(rotation_deg, shift_m, seed))
        error, sigma = error_of(found), sigma_of(found)
        assert abs(error[2]) < np.radians(0.12)
        assert np.abs(error[3:5]).max() < 0.06
        assert np.all(np.abs(error[:5]) < 3 * sigma[:5])
        assert abs(found.time_offset_s - DT_S) < 3 * found.time_offset_sigma_s


def test_a_radar_without_elevation_leaves_roll_and_pitch_to_the_prior():
    prior = prior_off_by(2, 0.1, 1)
    found = solve(street_day(24, elevation=False), prior)
    assert not found.observable[[0, 1, 5]].any()
    assert_kept(found, prior)
    assert abs(error_of(found)[2]) < np.radians(0.2)
    assert any("roll, pitch" in note for note in found.notes)
    assert any("measures no elevation" in note for note in found.notes)
    # What rests on the prior is the same every day, and so is what yaw errs by through roll; what streets leave varies.
    varying = np.diag(change_covariance(found.T, found.covariance - found.common_covariance))
    total = np.diag(change_covariance(found.T, found.covariance))
    assert np.allclose(varying[[0, 1, 5]], 0, atol=1e-3 * total[[0, 1, 5]].max())
    assert varying[2] > np.radians(0.01) ** 2


def test_a_roll_that_nobody_measures_leaves_yaw_as_open_as_its_errors_show():
    off = changed(T_LIDAR_RADAR, np.radians([3.0, 0, 0, 0, 0, 0]))
    found = solve(street_day(24, elevation=False), Prior(T_CAMERA_LIDAR, off, SIGMA_ROTATION, SIGMA_SHIFT))
    error = change_between(T_LIDAR_RADAR, found.T)
    assert abs(error[2]) > np.radians(0.06)  # a roll of 3 deg does that much
    assert abs(error[2]) < 3 * sigma_of(found)[2]
    assert sigma_of(found)[2] < np.radians(0.2)


def test_a_height_that_the_day_cannot_tell_stays_while_a_knock_aside_is_found(day):
    knocked = T_LIDAR_RADAR.copy()
    knocked[:3, 3] += [0.0, 0.12, 0.04]
    prior = Prior(T_CAMERA_LIDAR, knocked, SIGMA_ROTATION, 0.03)
    found = solve(day[:24], prior)
    assert_kept(found, prior)
    assert not found.observable[5]
    assert found.observable[4]
    assert abs(found.T[1, 3] - T_LIDAR_RADAR[1, 3]) < 0.04  # four prior sigmas away, all but a quarter found
    assert any("z" in note and "kept at the prior" in note for note in found.notes)


def test_much_of_roll_is_drawn_anew_every_day_and_most_of_pitch_is_not(day):
    """What noise makes of roll differs from day to day; what the beam spacing makes of it is the same every day."""
    found = solve(day[:24], Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, SIGMA_ROTATION, SIGMA_SHIFT))
    assert found.observable[:2].all()
    alike = np.diag(found.common_covariance) / np.diag(found.covariance)
    assert 0.3 < alike[0] < 0.7
    assert alike[1] > 0.5


def test_frames_of_a_turn_that_no_odometry_measured_are_left_out(day):
    slides = np.array([8.0, 1.0, 0.0])
    turn = [
        replace(o, radar_velocity_mps=slides, ego_speed_mps=8.0, ego_yaw_rate_radps=None) for o in day[:6]
    ]
    straight = [replace(o, ego_yaw_rate_radps=None) for o in day[6:24]]
    found = solve([*turn, *straight], prior_off_by(1, 0.02))
    assert found.frames_used == len(straight)
    assert found.frames_rejected == {"turns at an unknown yaw rate": 6}


def test_a_radar_of_poor_elevation_is_not_trusted_with_roll(day, found):
    rng = np.random.default_rng(5)

    def blurred(o):
        aer = to_spherical(o.radar_xyz_m.astype(np.float64))
        aer[:, 1] += np.radians(4.0) * rng.standard_normal(len(aer))
        return replace(o, radar_xyz_m=from_spherical(aer).astype(np.float32))

    poor = solve([blurred(o) for o in day[:20]], prior_off_by(1, 0.02))
    assert sigma_of(poor)[0] > 1.5 * sigma_of(found)[0]  # which is no surer than its lidar's beams are apart
    for one in (found, poor):
        assert abs(error_of(one)[0]) < 3 * sigma_of(one)[0]


def with_road(day, pitched_deg=0.0):
    """The same day with its ground known, and velocities that point up by so much."""
    up = exp_so3(np.array([0.0, -np.radians(pitched_deg), 0.0]))
    ground = [(o.lidar_map_xyz_m[:, 2] < GROUND_M + 0.01).astype(np.uint8) for o in day]
    return [
        replace(o, lidar_map_is_ground=g, radar_velocity_mps=up @ o.radar_velocity_mps)
        for o, g in zip(day, ground, strict=True)
    ]


def test_the_way_along_the_road_makes_pitch_surer_and_one_that_contradicts_less_sure(day, found):
    seeing, contradicting = (solve(with_road(day[:20], deg), prior_off_by(1, 0.02)) for deg in (0.0, 3.0))
    assert found.diagnostics["doppler_frames"] == 0
    assert seeing.diagnostics["doppler_frames"] >= 10
    assert seeing.covariance[1, 1] < 0.8 * found.covariance[1, 1]
    assert abs(error_of(seeing)[1]) < 3 * sigma_of(seeing)[1]
    assert not any("contradict" in note for note in seeing.notes)
    assert contradicting.covariance[1, 1] > 4 * seeing.covariance[1, 1]
    assert any("sources of radar pitch contradict each other" in note for note in contradicting.notes)


def test_a_constant_elevation_error_turns_pitch_leaves_roll_and_is_named_as_an_assumption(day, found):
    turned = change_between(found.T, solve(elevated(day[:20], np.radians(1.0)), prior_off_by(1, 0.02)).T)
    assert 0.8 < np.degrees(turned[1]) < 1.1  # all but the prior's share
    assert abs(np.degrees(turned[0])) < 0.15
    notes = "\n".join(found.notes)
    assert "own constant elevation error (0 +- 0.20 deg)" in notes
    assert "range bias" in notes


def test_detections_by_way_of_the_road_turn_the_radar_by_less_than_its_sigma(day, found):
    bent = solve(bounced(day[:20], T_LIDAR_RADAR, 1 / 6, np.random.default_rng(0)), prior_off_by(1, 0.02))
    turned = change_between(found.T, bent.T)
    assert np.all(np.abs(turned[:2]) < sigma_of(bent)[:2])


def test_stamps_that_are_all_late_by_as_much_change_the_time_offset_by_it_and_nothing_else(day, found):
    late = [replace(o, radar_stamp_ns=o.radar_stamp_ns + 60_000_000) for o in day[:20]]
    b = solve(late, prior_off_by(1, 0.02))
    np.testing.assert_allclose(found.T, b.T, atol=1e-6)
    assert b.time_offset_s - found.time_offset_s == pytest.approx(-0.06, abs=1e-5)


def test_stamps_whose_gaps_vary_lead_to_the_same_pose_and_time_offset():
    """Each scan is moved to its sweep by its own gap: the other way round, detections lie up to 1.3 m beside."""
    gaps_s = np.random.default_rng(8).uniform(-0.04, 0.04, 40)
    found = solve(street_day(40, gaps_s=gaps_s), prior_off_by(1.0, 0.03))
    error, sigma = error_of(found), sigma_of(found)
    assert np.all(np.abs(error[:5]) < 3 * sigma[:5])
    assert abs(error[2]) < np.radians(0.12)
    assert np.abs(error[3:5]).max() < 0.06
    assert abs(found.time_offset_s - DT_S) < 3 * found.time_offset_sigma_s
    assert found.time_offset_sigma_s < 0.006


def test_a_standing_car_does_not_determine_the_time_offset():
    still = [replace(o, radar_velocity_mps=np.zeros(3)) for o in street_day(16, dt_s=0.0)]
    found = solve(still, prior_off_by(1, 0.02))
    assert found.time_offset_s == pytest.approx(0.001)  # what the stamps' constant gap of -1 ms suggests
    assert found.time_offset_sigma_s == pytest.approx(CONFIG.time_offset_sigma_s)
    assert any("time offset: not determined" in note for note in found.notes)


def test_too_few_frames_are_refused(day):
    with pytest.raises(SolveError, match="lidar-radar needs 5 frames"):
        solve(day[:3], prior_off_by(1, 0.02))
    deaf = [replace(o, radar_velocity_mps=None) for o in day]
    with pytest.raises(SolveError, match="the day has 0"):
        solve(deaf, prior_off_by(1, 0.02))


def turned_at_noon(day, axis, turn_deg):
    """First and last part of a day after whose half the radar is turned about one of its axes."""
    turn = exp_so3(np.radians(turn_deg) * np.eye(3)[axis])
    turned = [replace(o, radar_xyz_m=(o.radar_xyz_m @ turn).astype(np.float32)) for o in day[20:]]
    return solve([*day[:20], *turned], prior_off_by(1, 0.02)).parts


def test_a_radar_that_turned_at_noon_shows_in_the_parts_of_the_day_with_time_and_size(day):
    parts = turned_at_noon(day, 2, 0.5)
    assert parts.sigmas(PART_FLOOR_RAD)[2] > MOVED_SIGMAS
    assert np.degrees(parts.step[2]) == pytest.approx(0.5, abs=0.1)
    assert parts.cut_ns == (day[19].stamp_ns, day[20].stamp_ns)
    wide = turned_at_noon(day, 2, -5.0)  # wider than the registration reaches
    assert abs(wide.sigmas(PART_FLOOR_RAD)[2]) > 10 * MOVED_SIGMAS
    assert np.degrees(wide.step[2]) == pytest.approx(-5.0, abs=0.2)
    quiet = turned_at_noon(day, 2, 0.0)
    assert quiet.tested == (0, 1, 2)
    assert np.abs(quiet.sigmas(PART_FLOOR_RAD)).max() < MOVED_SIGMAS


def test_a_radar_that_tilted_at_noon_tilts_its_parts_and_leaves_yaw(day):
    """Where nothing but boxes and the registration knows pitch, less than the turn, for sigmas of half a degree."""
    parts = turned_at_noon(day, 1, -2.0)
    assert 0.4 < np.degrees(parts.step[1]) / -2.0 < 1.2
    assert abs(parts.sigmas(PART_FLOOR_RAD)[2]) < MOVED_SIGMAS


def test_the_held_out_cost_of_camera_radar_prefers_the_truth_and_names_frames_that_cannot_tell(day):
    silent = {"radar_velocity_mps": None, "radar_cluster": np.full_like(day[8].radar_cluster, -1)}
    frames = [*day[:8], replace(day[8], **silent)]
    wrong = exp_se3(np.array([0, 0, np.radians(1.0), 0, 0, 0])) @ T_LIDAR_RADAR
    camera_right, camera_wrong = (
        camera_radar_cost(frames, T_CAMERA_LIDAR @ T) for T in (T_LIDAR_RADAR, wrong)
    )
    assert np.nanmean(camera_right) < np.nanmean(camera_wrong)
    assert np.isnan(camera_right[8])


def test_an_azimuth_that_two_turns_explain_alike_is_left_open(day):
    """Few matches, or cars in the next lane that meet the boxes of this one: no loop is judged by such an azimuth."""
    prior, rng = prior_off_by(1, 0.02, 0), np.random.default_rng(0)
    sure, unsure = (estimate_camera_radar(some, prior, CONFIG, rng) for some in (day, day[:6]))
    assert sure.observable.tolist()[:3] == [True, True, True]
    assert not unsure.observable[1]
    assert unsure.observability[1] == 0
    assert any("azimuth is not determined" in note for note in unsure.notes)
    assert unsure.observable[[0, 2]].all()


def test_camera_and_radar_alone_find_their_azimuth(day):
    found = estimate_camera_radar(day, prior_off_by(4, 0.05), CONFIG, np.random.default_rng(0))
    error = log_se3(found.T @ np.linalg.inv(T_CAMERA_LIDAR @ T_LIDAR_RADAR))
    assert abs(error[1]) < np.radians(0.5)
    assert np.all((np.abs(error) < 3.5 * sigma_of(found))[:3][found.observable[:3]])
    assert not found.observable[3:].any()

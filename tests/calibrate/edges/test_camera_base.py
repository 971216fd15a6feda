"""A camera's pose on the car and clock by its own motion: within sigma of the truth, or not at all."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.edges.camera_base import (
    CameraTravel,
    _expected,
    camera_travel,
    elsewhere,
    estimate_camera_base,
)
from pipeline.calibrate.edges.on_base import DaySources, changes_by_left
from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.core.errors import SolveError
from pipeline.objective.ego_motion import EgoMotion
from pipeline.rig.graph import BASE, Edge, Sensor
from pipeline.rig.prior import RigPrior
from pipeline.rig.se3 import change_between, exp_so3, from_rotation_translation, inverse, rotation_angle_rad
from tests.makers.solve_scenes import make_day

EDGE = Edge(Sensor("front", "camera"), BASE)
N, SPAN_S, STEP_S, LATE_S = 240, 0.3, 0.5, 0.012
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
NOISE = np.radians(0.08)  # of turn and direction, a pair


def mounted(yaw_deg=0.0, pitch_deg=3.0, roll_deg=-1.0):
    R = exp_so3(np.radians([0.0, 0.0, yaw_deg])) @ exp_so3(np.radians([0.0, pitch_deg, 0.0]))
    return from_rotation_translation(
        R @ OPTICAL @ exp_so3(np.radians([0.0, 0.0, roll_deg])), np.array([1.8, 0.6, 1.5])
    )


def day(T, seed=1, *, turning=0.25, late_s=LATE_S, body_deg=0.1, scale=1.0, noise=NOISE, lean_deg=7.0):
    """A drive along bends of a camera at T = T_base_camera, whose base sways, and leans outward by so much a g."""
    rng = np.random.default_rng(seed)
    t = np.arange(N) * STEP_S
    speed = 10 + 3 * np.sin(t / 7)

    def rate(at):
        return turning * np.sin(at / 3.0)

    def turned(at):  # exactly, from `at` less the span
        return -3.0 * turning * (np.cos(at / 3.0) - np.cos((at - SPAN_S) / 3.0))

    a = turned(t - late_s)
    body = rng.normal(0, np.radians(body_deg), (N, 2))
    leaning = a * np.radians(lean_deg) * speed * rate(t - late_s - SPAN_S / 2) / 9.81
    turn = np.stack([body[:, 0], body[:, 1] + leaning, a], 1)
    way = speed * SPAN_S
    translation = np.stack([way, 0 * way, 0 * way], 1) + np.cross(turn, T[:3, 3]) * [1, 1, 0]
    translation[:, 2] += rng.normal(0, np.radians(body_deg), N) * way
    direction = translation / np.linalg.norm(translation, axis=1, keepdims=True)
    noisy = direction @ T[:3, :3] + rng.normal(0, noise, (N, 3))
    covariance = np.tile(np.eye(6) * noise**2, (N, 1, 1))
    return CameraTravel(
        (turn @ T[:3, :3] + rng.normal(0, noise, (N, 3))) * scale,
        noisy / np.linalg.norm(noisy, axis=1, keepdims=True),
        covariance, way, turned(t) + rng.normal(0, 1e-4, N), rate(t) - rate(t - SPAN_S), np.full(N, SPAN_S),
        (t * 1e9).astype(np.int64), np.arange(N) // 120, np.arange(N) // 4,
    )  # fmt: skip


def start(T, off_deg=(1.5, -1.5, 2.0)):
    return from_rotation_translation(exp_so3(np.radians(off_deg)) @ T[:3, :3], T[:3, 3])


def error_and_sigma(evidence, T):
    """Roll, pitch and yaw in axes of the base [rad]; infinite sigmas where nothing is known."""
    found = inverse(evidence.T)
    J = np.linalg.inv(changes_by_left(found))
    information = np.diag(J.T @ evidence.information[:6, :6] @ J)[:3]
    return change_between(found, T)[:3], np.where(information > 1e-3, information + 1e-12, 1e-12) ** -0.5


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 180.0])
def test_pose_and_clock_come_out_within_sigma_wherever_the_camera_looks(yaw_deg):
    T = mounted(yaw_deg)
    z, late = [], []
    for seed in range(8):
        evidence = estimate_camera_base(EDGE, day(T, seed), start(T))
        error, sigma = error_and_sigma(evidence, T)
        assert np.degrees(sigma).max() < 0.25
        z.append(error / sigma)
        late.append((evidence.dt_s - LATE_S) * evidence.information[6, 6] ** 0.5)
        assert evidence.information[6, 6] ** -0.5 < 0.01
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 1.6
    assert np.sqrt(np.mean(np.square(late))) < 1.6


def test_bends_to_one_side_leave_roll_as_unsure_as_the_lean_of_bodies():
    T, z = mounted(), []
    for seed, lean_deg in enumerate(np.random.default_rng(3).normal(5.0, 3.0, 12)):
        travel = day(T, seed, lean_deg=float(lean_deg))
        left = CameraTravel(**{n: values[travel.turned_rad > 0] for n, values in vars(travel).items()})
        error, sigma = error_and_sigma(estimate_camera_base(EDGE, left, start(T)), T)
        assert 0.1 < np.degrees(sigma[0]) < 0.8
        z.append(error[0] / sigma[0])
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.6


def test_hills_within_bends_pass_for_roll_the_more_the_less_a_car_turns():
    T, roll_deg = mounted(), {}
    for turning in (0.25, 0.05):
        base = estimate_camera_base(EDGE, day(T, turning=turning), start(T)).bias["base"]
        roll_deg[turning] = np.degrees(np.sqrt(base[0, 0]))
    assert 0.1 < roll_deg[0.25] < 0.5
    assert roll_deg[0.05] > 3 * roll_deg[0.25]


def test_the_way_between_two_images_is_that_of_a_path_that_begins_to_bend():
    T, span_s, speed, bends = mounted(), 0.5, 12.0, np.array([0.6, -0.4])  # rad/s^2
    s = np.linspace(-span_s / 2, span_s / 2, 4001)
    heading = 0.1 * s + bends[:, None] * s**2 / 2
    turned, midway = heading[:, -1] - heading[:, 0], (heading[:, -1] + heading[:, 0]) / 2
    path = speed * np.trapezoid(np.exp(1j * (heading - midway[:, None])), s, axis=1)
    path += complex(*T[:2, 3]) * 2j * np.sin(turned / 2)
    nothing = [np.zeros((2, k)) for k in (3, 3, 0)]
    ego = np.full(2, speed * span_s), turned, bends * span_s, np.full(2, span_s)
    travel = CameraTravel(*nothing, *ego, *[np.arange(2)] * 3)
    found = _expected(travel, T, turned[:, None] * [0.0, 0.0, 1.0])
    assert np.arctan2(*found.T[::-1]) == pytest.approx(np.angle(path), abs=1e-4)


@pytest.mark.parametrize(("off_m", "body_deg"), [((1.0, 0.0, 0.0), 0.1), ((0.0, 0.0, 0.4), 0.4)])
def test_a_wrong_lever_arm_or_axis_of_rolling_is_no_yaw_and_hardly_noise(off_m, body_deg):
    T, moved = mounted(), mounted()
    moved[:3, 3] += off_m
    plain, found = (estimate_camera_base(EDGE, day(T, body_deg=body_deg), start(of)) for of in (T, moved))
    error, sigma = error_and_sigma(found, T)
    assert abs(error[2]) < 3 * sigma[2]
    assert sigma[2] < 1.3 * error_and_sigma(plain, T)[1][2]


def test_what_the_base_turns_corrects_the_direction_of_travel():
    """Tracks confuse a turn with a shift: by the base's turn the error of the direction goes, with its sigma."""
    T, confused = mounted(), np.radians(0.03)
    travel = day(T, turning=0.05, noise=np.radians(0.005))
    error = np.random.default_rng(5).normal(0.03, 0.03, N)[:, None] * np.radians(1)
    turn = travel.turn + error * T[2, :3]
    direction = travel.direction - 8 * error * T[1, :3]
    covariance = travel.covariance.copy()
    covariance[:, :3, :3] += confused**2 * np.outer(T[2, :3], T[2, :3])
    covariance[:, 3:, 3:] += 64 * confused**2 * np.outer(T[1, :3], T[1, :3])
    covariance[:, :3, 3:] -= 8 * confused**2 * np.outer(T[2, :3], T[1, :3])
    covariance[:, 3:, :3] = covariance[:, :3, 3:].transpose(0, 2, 1)
    confused_travel = replace(travel, turn=turn, direction=direction, covariance=covariance)
    silent = np.full(N, np.nan)
    unaided = replace(confused_travel, driven_m=silent, turned_rad=silent, turned_by_clock_radps=silent)
    with_turn, alone = (
        error_and_sigma(estimate_camera_base(EDGE, of, start(T)), T) for of in (confused_travel, unaided)
    )
    assert abs(alone[0][2]) > np.radians(0.15)
    assert abs(with_turn[0][2]) < np.radians(0.06)
    assert np.radians(0.04) < with_turn[1][2] < np.radians(0.12)  # by what a yaw rate may drift


def test_straight_driving_determines_neither_roll_nor_clock_and_says_so():
    T = mounted()
    evidence = estimate_camera_base(EDGE, day(T, turning=0.0), start(T))
    _, sigma = error_and_sigma(evidence, T)
    assert sigma[0] > 1e3
    assert np.degrees(sigma[1:]).max() < 0.1
    assert evidence.information[6, 6] == 0
    assert {note.split(" to ")[0].split(" against ")[0] for note in evidence.notes} >= {"roll", "clock"}


def test_without_odometry_and_doppler_the_straights_still_show_yaw_and_pitch():
    T = mounted()
    silent = np.full(N, np.nan)
    travel = replace(day(T, turning=0.02), driven_m=silent, turned_rad=silent, turned_by_clock_radps=silent)
    error, sigma = error_and_sigma(estimate_camera_base(EDGE, travel, start(T)), T)
    assert (np.abs(error[1:]) < 4 * sigma[1:]).all()
    assert np.degrees(sigma[1:]).max() < 0.2


def test_focal_length_shows_in_turns_and_a_mirrored_image_is_named():
    T = mounted()
    numbers = estimate_camera_base(EDGE, day(T, scale=0.98), start(T)).diagnostics
    assert abs(numbers["focal_by_turns"] + 0.02) < 3 * numbers["focal_by_turns_sigma"] < 0.02
    travel = day(T)
    mirror = np.diag([-1.0, 1.0, 1.0])  # left and right swapped in the picture: directions and axial turns
    mirrored = replace(travel, turn=-travel.turn @ mirror, direction=travel.direction @ mirror)
    [check] = estimate_camera_base(EDGE, mirrored, start(T)).checks
    assert check.disproves
    assert check.fault == "orientation"


def test_traffic_that_pulls_single_pairs_away_moves_little():
    T = mounted()
    travel = day(T)
    direction = travel.direction.copy()
    direction[::7] += [0.2, 0.0, 0.0]
    error, sigma = error_and_sigma(
        estimate_camera_base(EDGE, replace(travel, direction=direction), start(T)), T
    )
    assert (np.abs(error) < 3 * sigma).all()


def test_a_day_with_few_pairs_is_refused_with_the_number():
    T = mounted()
    few = CameraTravel(**{name: values[:5] for name, values in vars(day(T)).items()})
    with pytest.raises(SolveError, match=r"^5 .* 8 "):
        estimate_camera_base(EDGE, few, start(T))


@pytest.mark.parametrize(("yaw_deg", "aside"), [(0.0, 0.02), (90.0, 0.1), (-90.0, 0.1), (180.0, 0.02)])
def test_a_camera_that_looks_aside_promises_no_sharp_yaw(yaw_deg, aside):
    T = mounted(yaw_deg, pitch_deg=0.0)
    found = estimate_camera_base(EDGE, day(T), start(T))
    J = changes_by_left(inverse(found.T))
    floor_deg = np.degrees(np.sqrt(np.diag(J @ found.bias["edge"] @ J.T)[:3]))
    assert floor_deg[2] == pytest.approx(aside, abs=0.02)
    assert floor_deg[1] < 0.03


def test_where_no_odometry_is_logged_way_and_yaw_are_those_of_the_moments_around():
    shown = {"motion_turn_rad": np.zeros(3), "motion_direction": np.eye(3)[0], "motion_covariance": np.eye(6)}
    rows = [replace(o, motion_span_s=0.3, **shown) for o in make_day(6)]
    velocity, rate = np.tile([10.0, 0.0], (6, 1)), np.full(6, 0.1)
    ego = EgoMotion(velocity, rate, np.tile(np.eye(3), (6, 1, 1)))
    found = camera_travel(rows, ego, Scenes.of(rows, 10))
    np.testing.assert_allclose(found.driven_m, 3.0)
    np.testing.assert_allclose(found.turned_rad, 0.03)
    np.testing.assert_allclose(found.turned_by_clock_radps, 0.0, atol=1e-12)


def found_elsewhere(T, off_deg, travel):
    known, names = {("front", "base"): inverse(start(T, off_deg))}, ("front", "base")
    prior = RigPrior((EDGE.parent, BASE), BASE, known, dict.fromkeys(names, (0.02, 0.05)))
    sources = DaySources(prior, (), (), lambda _: [], read={"front": (travel, N)})
    return elsewhere(EDGE, sources, np.radians(6.0))


@pytest.mark.parametrize("off_deg", [(0, 0, 30), (30, 0, 0), (0, 90, 0), (0, 0, -90), (60, -60, 60)])
def test_a_camera_is_found_from_anywhere_by_direction_and_turns(off_deg):
    T = mounted()
    found = found_elsewhere(T, off_deg, day(T))
    assert np.degrees(rotation_angle_rad(found @ inverse(T))) < 0.5
    assert found[:3, 3] == pytest.approx(T[:3, 3])


def test_no_camera_is_elsewhere_that_is_near_mirrored_or_turned_where_nothing_shows_it():
    T, straight, mirror = mounted(), day(mounted(), turning=0.0), np.diag([-1.0, 1.0, 1.0])
    travel = day(T)
    mirrored = replace(travel, turn=-travel.turn @ mirror, direction=travel.direction @ mirror)
    assert found_elsewhere(T, (3, -4, 5), travel) is None
    assert found_elsewhere(T, (0, 0, 0), mirrored) is None
    assert found_elsewhere(T, (60, 0, 0), straight) is None
    assert rotation_angle_rad(found_elsewhere(T, (0, 0, 60), straight) @ inverse(T)) < np.radians(0.5)

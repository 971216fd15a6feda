"""What one log may say of the calibration in use: fail, warn, pass, or that it cannot tell; other spellings of it."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.config import VerifyConfig
from pipeline.rig.graph import Sensor
from pipeline.rig.prior import RigPrior
from pipeline.rig.se3 import exp_se3, inverse, rotation_angle_rad, to_quaternion
from pipeline.verify.axes import (
    answer_of,
    answers_by_sensor,
    check_axes,
    check_pose,
    errors_in_words,
    kind_of_pose,
    limits_of,
    shared_sigmas,
    wrong_sensors,
)
from pipeline.verify.one_axis import AxisLimits, HeldOut, power_of
from pipeline.verify.one_log import check_poses, on_grid
from schemas.calibrations import FRAMES_OF_PAIR, CalibrationRecord
from schemas.poses import PoseRow
from tests.makers.solve_scenes import T_CAMERA_LIDAR

ASKED_DEG = (0.5, 1.0)

DEG = np.pi / 180

NAMES = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")


def columns(T, prefix=""):
    return {f"{prefix}{n}": float(v) for n, v in zip(NAMES, (*to_quaternion(T), *T[:3, 3]), strict=True)}


def record(off_deg=0.0, sigma_deg=0.04, pair="camera_lidar", axis=1, status="accepted", **fields):
    """A log's record; the calibration in use lies `off_deg` from its answer, about one axis of the parent."""
    found = T_CAMERA_LIDAR if pair.startswith("camera") else np.eye(4)
    turn = np.zeros(6)
    turn[axis] = off_deg * DEG
    parent, child = FRAMES_OF_PAIR[pair]
    return CalibrationRecord(
        vehicle="car", day="2026-03-02", method="joint", pair=pair, parent_frame=parent, child_frame=child,
        status=status, reason=fields.pop("reason", ""), work_key="k", code_version="v", seed=0, inputs=[],
        frames_total=40, covariance=np.diag([*[(sigma_deg * DEG) ** 2] * 3, *[1e-8] * 3]),
        **columns(found), **columns(exp_se3(turn) @ found, "prior_"), **fields,
    )  # fmt: skip


def axes(of):
    return {c.axis: c for c in check_axes(of, limits_of(of.pair, VerifyConfig(), ASKED_DEG))}


def test_a_calibration_that_agrees_passes_with_what_the_pass_is_worth():
    azimuth = axes(record(0.03))["azimuth"]
    assert azimuth.status == "pass"
    assert abs(azimuth.off_rad) == pytest.approx(0.03 * DEG, rel=0.05)
    assert azimuth.power > 0.999
    assert azimuth.shown_rad == pytest.approx((0.2 + 1.645 * 0.04) * DEG, rel=0.05)


UNSURE = {"status": "held", "diagnostics": {"unsure_only": 1.0}}


@pytest.mark.parametrize(
    ("of", "axis", "status"),
    [
        (record(0.5, axis=1), "azimuth", "fail"),
        (record(0.5, axis=0), "elevation", "fail"),
        (record(0.5, axis=2), "roll", "fail"),
        (record(0.15, 0.03), "azimuth", "warn"),  # measured, and does not matter
        (record(0.0, 0.2), "azimuth", "inconclusive"),  # it would not have shown the error asked for
        # A record held for its sigma alone counts as far as that goes.
        (record(0.5, 0.09, **UNSURE), "azimuth", "fail"),
        (record(0.5, 0.2, **UNSURE), "azimuth", "inconclusive"),
        # A radar's limits are its own.
        (record(0.5, pair="lidar_radar", axis=2), "azimuth", "fail"),
        (record(0.35, pair="lidar_radar", axis=2), "azimuth", "warn"),
        (record(0.5, pair="lidar_radar", axis=1), "elevation", "warn"),
    ],
)
def test_an_axis_fails_alone_warns_or_cannot_tell_by_error_sigma_and_limit(of, axis, status):
    found = axes(of)
    assert found[axis].status == status
    assert [a for a, c in found.items() if c.status == "fail"] == [axis] * (status == "fail")
    assert status != "inconclusive" or found[axis].power < VerifyConfig().confidence
    assert ("roll" in found) == (of.pair == "camera_lidar")


def test_of_many_sensors_it_is_right_where_pairs_that_pass_tie_them_all():
    def checks(*pairs):
        named = [replace(record(0.0, sigma), parent_frame=a, child_frame=b) for a, b, sigma in pairs]
        return [c for r in named for c in check_axes(r, limits_of("camera_lidar", VerifyConfig(), ASKED_DEG))]

    # The right camera is unsure beside the nose, and sure beside the top, which the nose is tied to by the left one.
    tied = [("left", "top", 0.04), ("left", "nose", 0.04), ("right", "top", 0.04), ("right", "nose", 0.4)]
    assert answer_of(checks(*tied)) == "right"
    assert answer_of(checks(*tied[:2], tied[3])) == "inconclusive"
    assert answer_of(checks(("left", "top", 0.04), ("right", "nose", 0.04))) == "inconclusive"


@pytest.mark.parametrize("off_deg", [0.0, 0.5])
def test_a_log_whose_own_answer_failed_a_check_says_nothing_of_the_one_in_use(off_deg):
    held = record(off_deg, status="held", reason="restarts disagree", diagnostics={"unsure_only": 0.0})
    assert {c.status for c in axes(held).values()} == {"inconclusive"}
    assert all("restarts disagree" in c.reason for c in axes(held).values())
    refused = replace(held, status="refused", qw=None, covariance=None, reason="no observations")
    assert {c.status for c in axes(refused).values()} == {"inconclusive"}
    assert "no observations" in axes(refused)["azimuth"].reason


def turned(sensor, axis, deg):
    """Checks of a rig of three whose calibration in use has one sensor turned about an axis of its own."""
    found = {"camera_lidar": T_CAMERA_LIDAR, "camera_radar": T_CAMERA_LIDAR, "lidar_radar": np.eye(4)}
    turn = np.zeros(6)
    turn[axis] = deg * DEG
    checks = []
    for pair, T in found.items():
        parent, child = FRAMES_OF_PAIR[pair]
        prior = T @ exp_se3(turn) if sensor == child else exp_se3(-turn) @ T if sensor == parent else T
        own = replace(record(pair=pair), **columns(T), **columns(prior, "prior_"))
        checks += check_axes(own, limits_of(pair, VerifyConfig(), ASKED_DEG))
    return checks


@pytest.mark.parametrize(
    ("sensor", "axis", "toward"),  # of the camera x right, y down, z forward, else x forward, y left, z up
    [
        ("camera", 1, "right"), ("camera", 0, "up"), ("radar", 2, "left"), ("radar", 1, "down"), ("lidar", 2, "left"),
    ],
)  # fmt: skip
def test_the_sensor_that_is_set_wrong_is_named_with_the_direction(sensor, axis, toward):
    checks = turned(sensor, axis, 0.9)
    assert wrong_sensors(checks) == [sensor]
    assert all(f"too far {toward} " in words for words in errors_in_words(checks))
    assert all(f"too far {toward} " not in words for words in errors_in_words(turned(sensor, axis, -0.9)))
    # One of two pairs does not decide: the sensor of the pair that passes is not it.
    (first, *_), kept = [c.pair for c in checks if c.status == "fail"], {}
    kept = [replace(c, status="inconclusive") if c.pair == first else c for c in checks]
    assert wrong_sensors(kept) == [sensor]


def test_a_rolled_camera_is_named_with_the_lidar_where_no_other_pair_has_a_roll():
    checks = turned("camera", 2, 0.9)
    assert wrong_sensors(checks) == ["camera", "lidar"]
    [words] = errors_in_words(checks)
    assert words.startswith(
        "camera: set 0.90 deg too far clockwise, or lidar: set 0.90 deg too far counterclockwise"
    )


def test_the_answer_needs_every_axis_that_a_pair_is_good_for():
    good = [c for p in FRAMES_OF_PAIR for c in axes(record(0.01, pair=p)).values()]
    assert answer_of(good) == "right"
    coarse = [replace(c, status="inconclusive") if c.axis == "elevation" else c for c in good]
    # A radar need not know its own.
    assert answer_of([c for c in coarse if c.pair != "camera_lidar"]) == "right"
    assert answer_of(coarse) == "inconclusive"
    assert answer_of([*good[1:], replace(good[0], status="fail")]) == "wrong"
    assert answer_of([]) == "inconclusive"


SIGMA_DEG = 0.04


def pose(sensor="front", kind="camera", off_deg=0.0, sigma_deg=SIGMA_DEG, axis=1, **fields):
    """A sensor's pose by the log, and the one in use, which is turned about an axis of the sensor."""
    T_in_use = inverse(T_CAMERA_LIDAR) if kind == "camera" else np.eye(4)
    turn = np.zeros(6)
    turn[axis] = off_deg * DEG
    row = PoseRow(
        vehicle="car", day="2026-03-02", method="joint", sensor=sensor, kind=kind, reference="top",
        status="accepted", reason="", code_version="v", covariance=np.diag([(sigma_deg * DEG) ** 2] * 3 + [1e-8] * 3),
        **columns(T_in_use @ exp_se3(turn)),
    )  # fmt: skip
    return replace(row, **fields), T_in_use


def pose_checks(row, T_in_use, beyond=3.0):
    return check_pose(row, T_in_use, limits_of(kind_of_pose(row.kind), VerifyConfig(), ASKED_DEG), beyond)


def test_of_many_sensors_each_is_right_wrong_or_undecided_by_its_own_pose():
    rows = [
        pose("front"), pose("left", off_deg=0.5), pose("rear", sigma_deg=0.4),
        pose("corner", "radar", off_deg=0.8, axis=2), pose("nose", "radar", off_deg=0.3, axis=2),
    ]  # fmt: skip
    T = {("top", row.sensor): T_in_use for row, T_in_use in rows}
    sensors = (top := Sensor("top", "lidar"), *(Sensor(row.sensor, row.kind) for row, _ in rows))
    prior = RigPrior(sensors, top, T, {s.name: (0.03, 0.05) for s in sensors})
    reference, lacking = replace(rows[0][0], sensor="top", kind="lidar"), [Sensor("gone", "radar")]
    found = [reference, *(row for row, _ in rows)]
    checks = check_poses(found, prior, lacking, VerifyConfig(), ASKED_DEG)
    said = answers_by_sensor(checks)
    wrong, undecided = {"left", "corner"}, dict.fromkeys(("rear", "gone"), "undecided")
    assert said == {"front": "right", "nose": "right"} | undecided | dict.fromkeys(wrong, "wrong")
    assert {(c.pair, c.axis) for c in checks if c.status == "fail"} == {(name, "azimuth") for name in wrong}
    assert answer_of(checks) == "wrong"
    assert set(wrong_sensors(checks)) == wrong
    assert answer_of([c for c in checks if c.pair in {"front", "rear"}]) == "inconclusive"
    assert answer_of([c for c in checks if c.pair in {"front", "nose"}]) == "right"


def test_a_sensor_whose_edges_contradict_each_other_or_that_is_not_in_the_calibration_is_undecided():
    held = {"faults": ["witnesses_disagree"], "status": "held", "reason": "its edges contradict"}
    row, in_use = pose(off_deg=0.5, **held)
    assert answers_by_sensor(pose_checks(row, in_use)) == {"front": "undecided"}
    assert "its edges contradict" in pose_checks(row, in_use)[0].reason
    checks = pose_checks(pose()[0], None)
    assert answers_by_sensor(checks) == {"front": "undecided"}
    assert {c.status for c in checks} == {"inconclusive"}


def test_right_calibrations_of_a_large_rig_are_called_wrong_as_rarely_as_those_of_one_axis():
    """26 axes at three sigmas each were wrong on 4 % of right rigs; the limits of size play no part at this sigma."""
    rng = np.random.default_rng(11)
    sigma, limits = 1.0, {"azimuth": AxisLimits(1e-6, np.radians(9), 0.9)}
    wrong = {False: 0, True: 0}
    for _ in range(300):
        # A rig is called wrong if its axis that is furthest off is.
        furthest = max(rng.normal(size=26), key=abs)
        row = pose("lidar", "lidar", off_deg=sigma * furthest, sigma_deg=sigma, axis=2)
        for shared in wrong:
            beyond = shared_sigmas(26) if shared else 3.0
            wrong[shared] += any(c.status == "fail" for c in check_pose(*row, limits, beyond))
    assert wrong[True] <= 4
    assert wrong[False] >= 8


def test_power_counts_what_held_out_frames_would_confirm():
    size, limit, sigma = 0.5 * DEG, 0.2 * DEG, 0.04 * DEG
    assert power_of(size, limit, sigma, 3.0) > 0.999
    blind = HeldOut({0.5: -0.1, -0.5: 0.2})
    assert power_of(size, limit, sigma, 3.0, blind) < 0.01
    # One sign would be confirmed, the other not: an error of either sign is as likely.
    assert power_of(size, limit, sigma, 3.0, HeldOut({0.5: -4.0, -0.5: 0.2})) == pytest.approx(0.5, abs=0.01)
    # What lies within some sigmas of the calibration in use needs no confirmation.
    wide = 0.14 * DEG
    assert power_of(size, limit, wide, 3.0, blind) == pytest.approx(0.716 - 0.334, abs=0.005)


def test_an_axis_that_held_out_frames_do_not_see_is_inconclusive_and_says_so():
    probes = {f"probe_z_{axis}_{deg:+g}": -5.0 for axis in ("azimuth", "elevation") for deg in (0.5, -0.5)}
    probes |= {"probe_z_roll_+0.5": 0.1, "probe_z_roll_-0.5": -0.2}
    found = axes(record(off_deg=0.02, diagnostics=probes))
    assert {axis: c.status for axis, c in found.items()} == {
        "azimuth": "pass", "elevation": "pass", "roll": "inconclusive",
    }  # fmt: skip
    assert "held-out frames align" in found["roll"].reason
    assert np.isnan(found["roll"].shown_rad)
    # Turns of 0.5 deg were tried, and an error of that size would have failed.
    assert found["azimuth"].shown_rad <= np.radians(0.5)


def test_digits_beyond_any_measurement_do_not_matter_and_the_pose_stays_where_it_is():
    rng = np.random.default_rng(4)
    alike = 0
    for _ in range(300):
        T = exp_se3(rng.normal(size=6))
        otherwise = T + rng.uniform(-3e-8, 3e-8, (4, 4)) * (np.arange(4)[:, None] < 3)
        alike += np.array_equal(on_grid(T), on_grid(otherwise))
        moved = on_grid(T)  # by half a cell of 1e-4 at most
        assert np.abs(moved[:3, 3] - T[:3, 3]).max() < 5.001e-5
        assert rotation_angle_rad(moved @ inverse(T)) < np.sqrt(3) * 5.001e-5
    assert alike > 295

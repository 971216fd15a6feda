"""Which sensor moved within the day and what records keep of it; mounting or clock far from the prior."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.calibrate.numerics.frame_blocks import with_parts
from pipeline.calibrate.records import half_days_of
from pipeline.calibrate.verify.day_checks import (
    clock_alarms,
    constancy_failures,
    moved_failures,
    prior_alarms,
)
from pipeline.core.config import ChecksConfig, SolveConfig
from pipeline.rig.estimates import DayParts, PairEstimate, Prior
from pipeline.rig.graph import edge_named
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR

CUT_NS = (1772447400 * 10**9, 1772447700 * 10**9)  # 10:30:00 and 10:35:00 UTC
SIGMA_RAD = {"camera_lidar": np.radians(0.05), "lidar_radar": np.radians(0.06)}


def turned(sensor, turn_deg, share):
    """Poses of both pairs where a sensor has made a share of its turn about its own axes."""
    M = from_rotation_translation(exp_so3(np.radians(turn_deg) * share), np.zeros(3))
    camera, lidar, radar = (M if sensor == s else np.eye(4) for s in ("camera", "lidar", "radar"))
    return {
        "camera_lidar": inverse(camera) @ T_CAMERA_LIDAR @ lidar,
        "lidar_radar": inverse(lidar) @ T_LIDAR_RADAR @ radar,
    }


def estimates(sensor="lidar", turn_deg=(0.0, 0.0, 0.0), *, with_radar=True):
    """A day whose estimates lie half-way, and whose parts are right."""
    first, middle, last = (turned(sensor, np.array(turn_deg), share) for share in (0.0, 0.5, 1.0))
    found = {}
    for pair, T in middle.items():
        tested = (0, 1, 2) if pair == "camera_lidar" else (2,)
        spread = np.eye(3) * SIGMA_RAD[pair] ** 2
        if pair == "lidar_radar":
            spread[:2, :2] = np.eye(2) * np.radians(20.0) ** 2
        parts = DayParts((first[pair], last[pair]), (spread, spread), CUT_NS, tested)
        found[pair] = PairEstimate(
            pair, T, np.eye(6) * 1e-6, np.ones(6), np.ones(6, bool), 40,
            parts=parts if with_radar or pair == "camera_lidar" else None,
        )  # fmt: skip
    T = middle["camera_lidar"] @ middle["lidar_radar"]
    found["camera_radar"] = PairEstimate(
        "camera_radar", T, np.eye(6) * 1e-6, np.ones(6), np.ones(6, bool), 40
    )
    return found


def test_a_quiet_day_fails_nothing():
    assert constancy_failures(estimates()) == {}
    assert constancy_failures(estimates("camera", (0.1, 0.1, 0.0))) == {}


@pytest.mark.parametrize(
    ("sensor", "turn_deg"),
    [("camera", (0, 1, 0)), ("lidar", (0, 0, -1)), ("radar", (0, 0, 1)), ("radar", (0, 0, -1))],
)
def test_the_sensor_whose_two_pairs_shift_is_named_with_time_and_size(sensor, turn_deg):
    failed = constancy_failures(estimates(sensor, turn_deg))
    mine = {pair for pair in ("camera_lidar", "camera_radar", "lidar_radar") if sensor in pair}
    assert set(failed) == mine
    assert {c.fault for checks in failed.values() for c in checks} == {"moved_in_day"}
    sentences = " ".join(c.sentence for checks in failed.values() for c in checks)
    assert "yaw turned by about" in sentences
    assert "1.00 deg" in sentences
    assert "between 10:30:00 and 10:35:00 UTC" in sentences
    assert f"the {sensor} moved" in sentences
    if sensor == "radar":  # the turn has the sign of the later part
        assert f"{turn_deg[2]:+d}.00 deg" in failed["lidar_radar"][0].sentence


@pytest.mark.parametrize(("sensor", "with_radar"), [("lidar", True), ("camera", False)])
def test_a_tilt_that_the_radar_does_not_see_leaves_two_sensors(sensor, with_radar):
    turn = (0.0, 1.0, 0.0) if sensor == "lidar" else (1.0, 0.0, 0.0)  # pitch of either
    failed = constancy_failures(estimates(sensor, turn, with_radar=with_radar))
    assert "the camera or lidar moved" in failed["camera_lidar"][0].sentence
    # Did the lidar tilt, then lidar-radar is a mean of two places: 1 deg at noon put its elevation five sigmas off.
    assert (
        failed["lidar_radar"][0].sentence == "the camera or lidar moved during the day, as camera-lidar shows"
    )


def test_the_one_sensor_of_a_rig_that_moved_loses_edges_that_do_not_show_it():
    def parts(edge, share_deg):
        T, M = T_LIDAR_RADAR, from_rotation_translation(exp_so3(np.radians([0, 0, share_deg])), np.zeros(3))
        # The grille is the parent of its pairs with radars: what it sees turns the other way.
        last = inverse(M) @ T if edge.parent.name == "grille" else T
        spread = np.diag(np.radians([20.0, 20.0, 0.06]) ** 2)
        return DayParts((T, last), (spread, spread), CUT_NS, (2,))

    pairs = [edge_named("lidar_radar", a, b) for a in ("grille", "top") for b in ("nose", "corner")]
    others = [edge_named("lidar_lidar", "grille", "top"), edge_named("lidar_base", "grille", "base"),
              edge_named("lidar_base", "top", "base")]  # fmt: skip
    failed = moved_failures({edge: parts(edge, 1.0) for edge in pairs}, [*pairs, *others])
    assert {edge.name for edge in failed} == {"grille-nose", "grille-corner", "grille-top", "grille-base"}
    assert "the grille moved during the day" in failed[others[0]][0].sentence
    assert {c.fault for checks in failed.values() for c in checks} == {"moved_in_day"}
    assert moved_failures({edge: parts(edge, 0.1) for edge in pairs}, [*pairs, *others]) == {}


def test_half_days_lead_from_the_record_to_where_the_sensor_was_and_is():
    found = estimates("lidar", (0.0, 0.0, 1.0))
    faults = {pair: ["moved_in_day"] for pair in found}
    first, last = (turned("lidar", np.array((0.0, 0.0, 1.0)), share) for share in (0.0, 1.0))
    for poses in (first, last):
        poses["camera_radar"] = poses["camera_lidar"] @ poses["lidar_radar"]
    for pair, estimate in found.items():
        half_days = half_days_of(pair, found, faults)
        for (change, sigma), poses in zip(half_days, (first, last), strict=True):
            R = exp_so3(change[:3]) @ estimate.T[:3, :3]
            np.testing.assert_allclose(R, poses[pair][:3, :3], atol=1e-9)
            np.testing.assert_allclose(estimate.T[:3, 3] + change[3:], poses[pair][:3, 3], atol=1e-9)
            assert np.all(sigma >= 0)
            assert sigma[:3].max() > 0
    assert half_days_of("camera_lidar", found, {pair: [] for pair in found}) is None


def test_a_step_that_few_scenes_cannot_prove_widens_the_sigma_by_half_of_it():
    found = estimates("lidar", (0.0, 0.0, 0.5))["camera_lidar"]
    few_scenes = replace(found.parts, spread=(np.eye(3), np.eye(3)))
    assert constancy_failures({"camera_lidar": replace(found, parts=few_scenes)}) == {}
    sigma = np.sqrt(np.diag(with_parts(found, few_scenes).covariance)[:3])
    np.testing.assert_allclose(
        sigma, np.hypot(0.001, np.where(np.abs(few_scenes.step) > 0.006, few_scenes.step / 2, 0.0))
    )
    assert sigma.max() > np.radians(0.2)
    sure = replace(found, covariance=np.eye(6))
    np.testing.assert_array_equal(with_parts(sure, few_scenes).covariance, sure.covariance)


def test_a_radar_that_turned_on_the_car_is_told_from_the_car():
    """Edges to the vehicle frame alone: with a second radar that stays, it is not the base."""

    def on_base(name, x_m, turn_deg):
        def at(turned_deg):
            R = exp_so3(np.radians([0.0, 0.0, turned_deg]))
            return inverse(from_rotation_translation(R, np.array([x_m, 0.0, 0.6])))

        sure = np.diag([0.0, 0.0, np.radians(0.06) ** 2])
        return edge_named("radar_base", name, "base"), DayParts(
            (at(0), at(turn_deg)), (sure, sure), CUT_NS, (2,)
        )

    def failed(**turns):
        parts = dict(on_base(name, x, turns.get(name, 0.0)) for name, x in (("nose", 3.6), ("tail", -1.0)))
        return {edge.parent.name: checks[0].sentence for edge, checks in moved_failures(parts, parts).items()}

    assert failed() == {}
    assert failed(nose=0.1) == {}
    assert list(failed(nose=1.0)) == ["nose"]
    # Of T_radar_base: where the radar turns to the left, the car turns to the right.
    assert failed(nose=1.0)["nose"].startswith("yaw turned by about -1.00 deg")
    assert failed(nose=1.0)["nose"].endswith("the nose moved")
    assert failed(nose=1.0, tail=1.0)["tail"].endswith("the base moved")


LIMITS = ChecksConfig()
SIGMA_M = 0.03
PRIOR = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(1.2), SIGMA_M)


def estimate_of(pair, kept=(), dt_s=0.0, **found):
    """A pair at its prior, with a few positions left to it."""
    observable = ~np.isin(np.arange(6), kept)
    covariance, timed = np.eye(6) * SIGMA_M**2, {"time_offset_s": dt_s, "time_offset_sigma_s": 0.005}
    return PairEstimate(
        pair, PRIOR.of(pair), covariance, observable * 1.0, observable, 50, diagnostics=found, **timed
    )


def test_a_position_left_to_the_prior_is_an_alarm_where_the_day_puts_it_elsewhere():
    z = {"own_z_prior": -2.0, "own_z_beyond": -2.0}
    cases = [
        ({"own_tx_m": 0.5, "own_tx_sigma_m": 0.1} | z, True),
        ({"own_tx_m": 0.1, "own_tx_sigma_m": 0.01} | z, False),  # a prior may be three sigmas off
        ({"own_tx_m": 0.5, "own_tx_sigma_m": 0.4} | z, False),  # the day does not know
        ({"own_tx_m": 0.5, "own_tx_sigma_m": 0.1} | z | {"own_z_beyond": 1.0}, False),  # a slope, no dip
    ]
    for found, is_alarm in cases:
        alarms = prior_alarms({"lidar_radar": estimate_of("lidar_radar", kept=[3], **found)}, PRIOR, LIMITS)
        assert [c.fault for c in alarms["lidar_radar"]] == ["prior"] * is_alarm


def test_a_clock_that_is_further_off_than_stated_is_an_alarm():
    for dt_s, named in ((0.12, []), (-0.5, ["time_offset"]), (0.5, ["time_offset"])):
        found = clock_alarms(
            {"lidar_radar": estimate_of("lidar_radar", dt_s=dt_s)}, {"lidar_radar": 0.05}, LIMITS
        )
        assert [c.fault for c in found.get("lidar_radar", [])] == named
    assert not clock_alarms(
        {"lidar_radar": estimate_of("lidar_radar", dt_s=0.5)}, {"lidar_radar": 0.2}, LIMITS
    )


@pytest.mark.parametrize(
    ("own", "is_alarm"), [((0.5, -5.0), True), ((0.5, -0.7), False), ((0.06, -5.0), False)]
)
def test_frames_that_align_far_better_at_another_offset_are_an_alarm_though_none_was_solved_for(
    own, is_alarm
):
    estimate = estimate_of("lidar_radar", own_dt_s=own[0], own_dt_z=own[1])
    found = clock_alarms({"lidar_radar": estimate}, {"lidar_radar": 0.05}, LIMITS)
    assert [c.fault for c in found.get("lidar_radar", [])] == ["time_offset"] * is_alarm


@pytest.mark.parametrize("off_m", [0.0, 0.4])
def test_a_radar_mounted_further_ahead_than_its_prior_says_is_found_though_x_is_left_to_the_prior(off_m):
    T = T_LIDAR_RADAR.copy()
    T[0, 3] += off_m
    prior = replace(PRIOR, T_lidar_radar=T, translation_sigma_m=0.01)
    found = estimate_lidar_radar(street_day(24, seed=5), prior, SolveConfig(), np.random.default_rng(0))
    alarms = prior_alarms({"lidar_radar": found}, prior, LIMITS)["lidar_radar"]
    own = found.diagnostics
    assert not found.observable[3]
    assert abs(own["own_tx_m"] + off_m) < 4 * own["own_tx_sigma_m"]
    assert [c.fault for c in alarms] == ["prior"] * (off_m > 0)

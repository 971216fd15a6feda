"""Sources of radar pitch: contradictions, detections seen too low, roll and pitch of radars that look anywhere."""

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar.elevation_errors import (
    SeenLow,
    along_radar,
    contradiction,
    doubted,
    following_tilt,
    own_equations,
    own_numbers,
    radar_tilt_axes,
    seen_low_of,
    tempered,
    tilt_of,
)
from pipeline.calibrate.numerics.nuisances import PartTurn
from pipeline.objective.radar.heights import Heights, HeightScores
from pipeline.objective.radar.travel import TravelDirections
from pipeline.rig.se3 import exp_so3, from_rotation_translation


def test_witnesses_that_contradict_each_other_widen_the_sigma_and_are_named():
    found = contradiction([PartTurn("registration", 0.0, 0.002), PartTurn("doppler", 0.012, 0.002)])
    # Two values six sigmas apart: chi-squared is 18 for one degree of freedom.
    assert found.factor == pytest.approx(np.sqrt(18))
    assert "registration +0.00 +- 0.11 deg" in found.sentence
    assert "doppler +0.69 +- 0.11 deg" in found.sentence


def test_errors_as_large_as_their_sigmas_seldom_contradict():
    rng = np.random.default_rng(0)
    sigma = np.array([0.002, 0.01, 0.003])
    found = [
        contradiction(
            [PartTurn(str(k), e, s) for k, (e, s) in enumerate(zip(rng.normal(0, sigma), sigma, strict=True))]
        )
        for _ in range(400)
    ]
    assert 0.01 < np.mean([f is not None for f in found]) < 0.15


def test_equations_give_the_step_with_nuisances_following():
    H, g = np.array([[4.0, 2.0], [2.0, 3.0]]), np.array([1.0, -1.0])
    equations = own_equations("boxes", H, g, 0.1)
    assert equations.offset_rad == pytest.approx(-np.linalg.solve(H, g)[0])
    assert equations.sigma_rad == pytest.approx(np.hypot(np.sqrt(3 / 8), 0.1))
    assert own_numbers([equations]) == {
        "boxes_pitch_offset_rad": equations.offset_rad,
        "boxes_pitch_sigma_rad": equations.sigma_rad,
    }


def test_who_turns_the_radar_further_up_than_displaced_heights_errs_by_that_and_nobody_else():
    heights = PartTurn("heights", 0.01, 0.004)
    up, down, near = (
        PartTurn(n, o, 0.003) for n, o in (("boxes", -0.02), ("doppler", 0.04), ("registration", 0.008))
    )
    found = doubted([up, down, near, heights])
    assert set(found) == {"boxes"}
    assert np.hypot(found["boxes"], np.hypot(0.003, 0.004)) == pytest.approx(0.03)
    assert doubted([up, down, near]) == {}


PER_SHARE_RAD = np.radians(5.0)


def ways(below):
    n = 12
    return TravelDirections(
        np.tile([10.0, 0.0, 0.0], (n, 1)), np.full(n, 0.01), np.zeros(n), np.full(n, -0.1), np.full(n, below),
        np.full(n, 0.08), np.arange(n),
    )  # fmt: skip


def heights(below):
    none = np.zeros(0)
    return Heights(0.0, np.eye(4), 0.3, 1.0, below, 0.05, HeightScores(none, none, none.astype(np.int64)))


def test_who_takes_all_for_seen_where_it_is_reads_higher_by_the_share_and_is_as_unsure_as_it():
    share = SeenLow(0.1, 0.06, {"registration": PER_SHARE_RAD})
    right = share.expected(PartTurn("registration", -0.1 * PER_SHARE_RAD, np.radians(0.4)))
    assert right.offset_rad == pytest.approx(0.0, abs=1e-12)
    assert np.degrees(right.sigma_rad) == pytest.approx(0.5)
    knows = PartTurn("heights", 0.01, 0.005)
    assert share.expected(knows) == knows


@pytest.mark.parametrize(("on_the_way", "displaced", "expected"), [(0.2, 0.03, 0.06), (0.04, 0.03, 0.04)])
def test_the_share_is_no_more_than_is_below_the_road_and_than_noise_images_and_strays_leave(
    on_the_way, displaced, expected
):
    found = seen_low_of(ways(on_the_way), heights(displaced))
    assert np.hypot(found.mean, found.sigma) == pytest.approx(expected, rel=1e-6)
    assert found.per_share_rad == pytest.approx({"registration": 0.08, "doppler": 0.1})


FLOOR = np.array([0.02, 0.004, 0.1])  # of the radar's own roll, pitch [rad] and z [m]


def looking(azimuth_deg, tilt=(0.0, 0.0)):
    R = exp_so3(np.array([0.0, 0.0, np.radians(azimuth_deg)])) @ exp_so3(np.array([*tilt, 0.0]))
    return from_rotation_translation(R, np.array([3.0, 0.5, -0.6]))


def equations(rng, frames=6, unknowns=3):
    A = rng.normal(size=(frames, unknowns, unknowns))
    return A @ np.swapaxes(A, 1, 2), rng.normal(size=(frames, unknowns))


@pytest.mark.parametrize("azimuth_deg", [0.0, 45.0, -45.0, 135.0])
def test_a_turned_radar_knows_as_much_about_its_own_axes(azimuth_deg):
    rng = np.random.default_rng(1)
    H_own, g_own = equations(rng)
    T = looking(azimuth_deg, tilt=(0.03, -0.02))
    axes = np.eye(3)
    axes[:2, :2] = radar_tilt_axes(T)
    expected, _ = tempered(H_own, g_own, np.diag(FLOOR**2))
    H, g = tempered(axes @ H_own @ axes.T, g_own @ axes.T, along_radar(T, FLOOR))
    found, _ = tilt_of(T, H.sum(0), g.sum(0))
    np.testing.assert_allclose(found, expected.sum(0), rtol=1e-9, atol=1e-9)


def test_the_weak_roll_of_a_corner_radar_is_not_its_roll_about_the_cars_axis():
    covariance = along_radar(looking(45.0), FLOOR)
    diagonal = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    across = np.array([-1.0, 1.0, 0.0]) / np.sqrt(2)
    assert diagonal @ covariance @ diagonal == pytest.approx(FLOOR[0] ** 2)
    assert across @ covariance @ across == pytest.approx(FLOOR[1] ** 2)
    assert np.allclose(along_radar(looking(0.0), FLOOR), np.diag(FLOOR**2))


def test_what_is_solved_with_a_wrong_tilt_errs_as_a_solution_with_it_shows():
    rng = np.random.default_rng(2)
    H, _ = equations(rng, 1, 5)
    H, prior, truth = H[0] + np.eye(5), np.diag([0.1] * 5), rng.normal(size=5)
    given, follows = np.array([0, 3]), np.array([1, 2, 4])
    wrong = truth.copy()
    wrong[given] += [0.3, -0.2]
    # Minimum over `follows` of the cost about the truth (and of a prior about it), the given ones wrong.
    block = np.ix_(follows, follows)
    pull = H[np.ix_(follows, given)] @ (wrong - truth)[given]
    wrong[follows] = truth[follows] - np.linalg.solve((H + prior)[block], pull)
    error = np.zeros(5)
    error[given] = [0.3, -0.2]
    np.testing.assert_allclose(following_tilt(H, prior, follows, given) @ error, wrong - truth, atol=1e-12)

"""Witnesses of radar pitch: what each says by itself, and what their contradictions do to the sigma."""

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar.elevation_errors import (
    contradiction,
    doubted,
    own_equations,
    own_numbers,
)
from pipeline.calibrate.joint.part_turn import PartTurn


def test_witnesses_that_contradict_each_other_widen_the_sigma_and_are_named():
    found = contradiction([PartTurn("registration", 0.0, 0.002), PartTurn("doppler", 0.012, 0.002)])
    # Two values six sigmas apart: chi-squared is 18 for one degree of freedom.
    assert found.factor == pytest.approx(np.sqrt(18))
    assert "registration +0.00 +- 0.11 deg" in found.sentence
    assert "doppler +0.69 +- 0.11 deg" in found.sentence


def test_the_widened_sigma_covers_both_sides():
    a, b = PartTurn("registration", 0.0, 0.002), PartTurn("doppler", 0.012, 0.004)
    found = contradiction([a, b])
    weight = np.array([a.sigma_rad, b.sigma_rad]) ** -2.0
    mean, sigma = weight @ [a.offset_rad, b.offset_rad] / weight.sum(), weight.sum() ** -0.5
    assert abs(b.offset_rad - mean) < 2.5 * found.factor * sigma


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

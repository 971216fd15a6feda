"""Reflectors found by themselves: robust means, the apex of a trihedral, the strongest radar echo."""

import numpy as np
import pytest

from pipeline.evaluate.reflectors import find_in_lidar, find_in_radar, robust_mean
from pipeline.rig.se3 import exp_so3, from_spherical

EDGE_M = 0.35


def test_the_robust_mean_leaves_strays_out_and_counts_what_is_left():
    rng = np.random.default_rng(1)
    samples = np.array([10.0, 2.0, 0.5]) + rng.normal(0, [0.05, 0.1, 0.2], (150, 3))
    samples[::10, 2] -= 4.0  # ground bounce
    mean, spread, count = robust_mean(samples)
    assert 125 <= count <= 135
    np.testing.assert_allclose(spread, [0.05, 0.1, 0.2], rtol=0.25)
    assert np.all(np.abs(mean - [10, 2, 0.5]) < 4 * spread / np.sqrt(count))


def radar_frames(at, count=150, sigma=(0.05, 0.1, 0.2)):
    rng = np.random.default_rng(2)
    for _ in range(count):
        clutter = np.array([*at]) + rng.uniform(-6, 6, (40, 3))
        points = np.vstack([at + rng.normal(0, sigma), clutter])
        yield points, np.concatenate([[70 + rng.normal(0, 2)], rng.normal(40, 5, 40)])


def test_the_strongest_radar_echo_near_the_guess_is_the_reflector():
    at = np.array([25.0, 3.0, 0.2])
    found = find_in_radar(list(radar_frames(at)), at + [0.5, -0.6, 3.0])
    assert found.frames > 130
    assert np.all(np.abs(found.position_m - at) < 4 * found.sigma_m)
    np.testing.assert_allclose(found.spread_m, [0.05, 0.1, 0.2], rtol=0.25)
    np.testing.assert_allclose(found.sigma_m, found.spread_m / np.sqrt(found.frames))


def trihedral_frames(apex, step_deg, turn=(0.0, 0.0, 0.0), count=40):
    """Beams on a grid of directions, on three plates that open towards the sensor, over a dull lot."""
    rng = np.random.default_rng(3)
    back = -apex * [1, 1, 0] / np.linalg.norm(apex[:2])
    side, up = np.array([-back[1], back[0], 0]), np.array([0, 0, 1.0])
    angles = np.radians([90, 210, 330])[:, None]
    edges = (
        back / np.sqrt(3) + (np.cos(angles) * side + np.sin(angles) * up) * np.sqrt(2 / 3)
    ) @ exp_so3(np.array(turn)).T  # fmt: skip
    grid = np.radians(np.arange(-30.07, 30, step_deg))
    directions = np.stack(
        [a.ravel() for a in np.meshgrid(grid, np.radians(np.arange(-10.04, 5, step_deg)))], 1
    )
    rays = from_spherical(np.concatenate([directions, np.ones((len(directions), 1))], 1))
    t = (edges @ apex) / (rays @ edges.T)
    reach = np.where(t > 0, t, np.inf).min(axis=1)
    with np.errstate(invalid="ignore"):
        inside = (rays * reach[:, None] - apex) @ edges.T  # coordinates along the edges
    hit = np.isfinite(reach) & np.all(inside > -1e-9, axis=1) & (inside.sum(axis=1) < EDGE_M)
    lot = rays[rays[:, 2] < -0.05][::10]
    lot = lot * (-1.8 / lot[:, 2:])
    for _ in range(count):
        noisy = rays[hit] * (reach[hit] + rng.normal(0, 0.02, hit.sum()))[:, None]
        yield (
            np.vstack([noisy, lot]),
            np.concatenate([rng.normal(70, 6, len(noisy)), rng.normal(5, 1, len(lot))]),
        )


@pytest.mark.parametrize("apex", [(14.8, -2.8, -0.3), (24.5, 3.2, -0.6), (39.7, 0.13, -0.17)])
def test_the_apex_is_found_within_its_sigma_though_no_beam_meets_it(apex):
    apex = np.array(apex)
    frames = list(trihedral_frames(apex, 0.25, turn=(0.01, -0.02, 0.015)))
    found = find_in_lidar(frames, apex + [0.2, -0.1, 0.1], EDGE_M)
    assert np.all(np.abs(found.position_m - apex) < 3 * found.sigma_m)
    assert found.sigma_m.max() < 0.04
    centre = find_in_lidar(frames, apex + [0.2, -0.1, 0.1])
    assert (
        np.linalg.norm(centre.position_m) < np.linalg.norm(apex) - 0.08
    )  # in front of it, where the plates are


@pytest.mark.parametrize("shift_m", [0.0, 0.03, 0.06, 0.09])
def test_one_or_two_beams_do_not_place_an_apex(shift_m):
    apex = np.array([39.7, 0.1, -0.2]) + [0, shift_m, shift_m]
    frames = list(trihedral_frames(apex, 0.4))
    assert find_in_lidar(frames, apex) is not None  # there are bright echoes
    assert find_in_lidar(frames, apex, EDGE_M) is None

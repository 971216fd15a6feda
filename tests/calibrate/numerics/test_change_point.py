"""A day in two parts: where it is cut, how far the parts are apart, and that a quiet day is not cut in earnest."""

import numpy as np
import pytest

from pipeline.calibrate.numerics.change_point import parts_of_day
from pipeline.calibrate.verify.constancy import MOVED_SIGMAS, PART_FLOOR_RAD
from pipeline.rig.se3 import exp_so3, from_rotation_translation

NOISE_RAD = np.radians(0.3)  # of a frame


def measured(rng, frames, turn_rad, after):
    """What each frame says of three rotations."""
    values = rng.normal(0, NOISE_RAD, (frames, 3))
    values[after:] += turn_rad
    return values


def parts_of(values, scene=None):
    """Parts of a day whose frames each measure the rotation vector, each of its own scene or of a given one."""

    def solve(rows):
        mean = values[rows].mean(axis=0)
        T = from_rotation_translation(exp_so3(mean), np.zeros(3))
        return mean, T, np.eye(3) * NOISE_RAD**2 / len(rows)

    def score(mean):
        return -0.5 * np.sum((values - mean) ** 2, axis=1) / NOISE_RAD**2

    scene = np.arange(len(values)) if scene is None else scene
    stamps = [k * 10**9 for k in range(len(values))]
    return parts_of_day(values - values.mean(axis=0), stamps, solve, score, (0, 1, 2), scene)


@pytest.mark.parametrize("after", [9, 16, 30, 40, 51])
def test_a_step_is_found_where_it_is_and_as_large(after):
    turn = np.radians([0.0, 0.8, -0.4])
    for seed in range(10):
        parts = parts_of(measured(np.random.default_rng(seed), 60, turn, after))
        assert abs(parts.cut_ns[1] / 1e9 - after) <= 2
        assert parts.cut_ns[1] - parts.cut_ns[0] == 10**9
        sigma = np.sqrt(np.diag(parts.spread[0] + parts.spread[1]))
        np.testing.assert_array_less(np.abs(parts.step - turn), 4 * sigma)
        assert np.abs(parts.sigmas(PART_FLOOR_RAD)).max() > MOVED_SIGMAS


def test_quiet_days_are_never_called_moved():
    """Cut where they differ most, parts of quiet days differ by two or three sigmas; few by more."""
    found = [
        np.abs(parts_of(measured(np.random.default_rng(seed), 60, 0.0, 60)).sigmas(0.0)).max()
        for seed in range(400)
    ]
    assert np.mean(np.array(found) > MOVED_SIGMAS) < 0.005
    assert 1.5 < np.median(found) < 3.0


def test_a_cut_leaves_three_scenes_on_either_side():
    """Of the last street two scenes are left: that they agree says nothing of how sure they are."""
    values = measured(np.random.default_rng(2), 60, np.radians([0.0, 0.0, 2.0]), 50)
    scene = np.r_[np.arange(50), np.repeat([50, 51], 5)]
    parts = parts_of(values, scene)
    assert parts.cut_ns[1] / 1e9 <= 49
    assert parts_of(values, np.r_[np.zeros(30, int), np.ones(30, int)]) is None
    assert parts_of(values[:20], np.repeat(np.arange(4), 5)) is None

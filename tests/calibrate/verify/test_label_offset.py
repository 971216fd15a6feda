"""Labels beside their picture are measured, named and held; what the day would not show widens the covariance."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.verify.label_offset import measure_label_offset, with_label_offset
from pipeline.extrinsics.estimates import PairEstimate, Solution
from schemas.calibrations import PAIRS
from tests.makers.label_pictures import HEIGHT, WIDTH, gradients_of
from tests.makers.solve_scenes import make_day

FRAMES = 12
BLOCKS = np.arange(FRAMES) // 2


def solution():
    pairs = {
        pair: PairEstimate(pair, np.eye(4), 1e-6 * np.eye(6), np.ones(6), np.ones(6, bool), 9)
        for pair in PAIRS
    }
    return Solution("joint", pairs)


def day(**slip):
    rows = make_day(FRAMES, seed=1)
    return [replace(o, label_gradients=g) for o, g in zip(rows, gradients_of(FRAMES, **slip), strict=True)]


def test_labels_in_place_are_not_flagged():
    offset = measure_label_offset(gradients_of(FRAMES), BLOCKS)
    assert not offset.is_beside
    assert np.abs(offset.shift_px).max() < 0.3
    assert (offset.open_px == 0).all()


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("right", [-1, 0, 1])
@pytest.mark.parametrize("down", [-1, 0, 1])
def test_a_shift_of_whole_pixels_is_measured_with_its_sign_and_flagged(size, right, down):
    if right == down == 0:
        return
    offset = measure_label_offset(gradients_of(FRAMES, right_px=size * right, down_px=size * down), BLOCKS)
    assert offset.is_beside
    # The picture lies where the labels came from.
    assert offset.shift_px == pytest.approx([-size * right, -size * down], abs=0.35)


@pytest.mark.parametrize("slip", ["wider", "higher"])
def test_a_slip_of_scale_shows_at_the_ends_and_not_in_the_middle(slip):
    offset = measure_label_offset(gradients_of(FRAMES, **{slip: 0.03}), BLOCKS)
    axis, half = (0, WIDTH / 2) if slip == "wider" else (1, HEIGHT / 2)
    assert offset.is_beside
    assert offset.ends_px[axis] == pytest.approx(-0.03 * half, rel=0.35)
    assert abs(offset.shift_px[axis]) < 0.6


def test_labels_of_another_picture_are_flagged_or_leave_the_shift_open():
    gradients = gradients_of(FRAMES, down_px=27)
    offset = measure_label_offset(gradients, BLOCKS)
    assert offset.is_beside or offset.open_px[1] > 1


def test_a_day_with_labels_beside_is_failed_by_name():
    found = with_label_offset(solution(), day(right_px=2))
    (check,) = found.failed_checks["camera_lidar"]
    assert check.fault == "labels_offset"
    assert "-2.0 +-" in check.sentence
    assert found.pairs["camera_lidar"].diagnostics["label_shift_u_px"] == pytest.approx(-2, abs=0.3)
    assert not found.failed_checks.get("lidar_radar")


def test_scenes_that_disagree_leave_a_pixel_open_down_the_image_and_widen_pitch_by_it():
    gradients = gradients_of(FRAMES)
    gradients[::2, 2:] = np.roll(gradients[::2, 2:], 4, -1)
    rows = [
        replace(o, label_gradients=g, drive=i)
        for i, (o, g) in enumerate(zip(make_day(FRAMES, seed=1), gradients, strict=True))
    ]
    estimate = with_label_offset(solution(), rows).pairs["camera_lidar"]
    open_px = measure_label_offset(gradients, np.arange(FRAMES)).open_px
    assert open_px[0] == 0
    assert open_px[1] > 0.3
    more = np.sqrt(np.diag(estimate.covariance) - 1e-6)
    focal_px = rows[0].camera_K[1, 1] * rows[0].label_scale
    assert more[0] == pytest.approx(open_px[1] / focal_px)
    assert more[1] == pytest.approx(open_px[0] / focal_px)
    assert more[2:].max() < 1e-9


def test_rows_of_an_earlier_release_change_nothing():
    before = solution()
    assert with_label_offset(before, make_day(3, seed=1)) is before

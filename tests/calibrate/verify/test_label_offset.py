"""Labels beside their picture are measured, named, and moved back or held; what is open widens the covariance."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from pipeline.calibrate.verify.day_labels import day_labels, measure_label_offset
from pipeline.perceive.labels import label_gradients
from pipeline.rig.estimates import PairEstimate, Solution
from schemas.calibrations import PAIRS
from tests.makers.solve_scenes import make_day

HEIGHT, WIDTH = 160, 320
SKY, BUILDING, CAR, POLE, ROAD = 10, 2, 13, 5, 0
_GREYS = {SKY: 220, BUILDING: 130, CAR: 60, POLE: 40, ROAD: 100}


@cache
def picture_and_labels(seed):
    """A noisy grey picture and labels without an error."""
    rng = np.random.default_rng(seed)
    labels = np.full((HEIGHT, WIDTH), ROAD, np.uint8)
    labels[:100] = BUILDING
    for x in range(0, WIDTH, 40):
        labels[: rng.integers(25, 60), x : x + 40] = SKY
    for x in rng.choice(np.arange(20, WIDTH - 50, 30), 5, replace=False):
        top, left, width = rng.integers(60, 90), x + rng.integers(0, 10), rng.integers(6, 25)
        labels[top : top + 45, left : left + width] = CAR if width > 10 else POLE
    grey = np.vectorize(_GREYS.get)(labels).astype(np.float32) + rng.normal(0, 8, labels.shape)
    return np.clip(cv2.GaussianBlur(grey, (0, 0), 0.8), 0, 255).astype(np.uint8), labels


def moved(labels, right_px=0, down_px=0, wider=0, higher=0):
    """Labels shifted, and stretched by a share about their middle."""
    height, width = labels.shape
    M = np.array(
        [
            [1 + wider, 0, right_px - wider * (width - 1) / 2],
            [0, 1 + higher, down_px - higher * (height - 1) / 2],
        ]
    )
    how = {"flags": cv2.INTER_NEAREST, "borderMode": cv2.BORDER_REPLICATE}
    return cv2.warpAffine(labels, M.astype(float), (width, height), **how)


def widened(labels, wide_px):
    """Labels whose objects are some pixels too wide on each side, as a coarse network's; not what is behind."""
    things = np.where(np.isin(labels, (CAR, POLE)), labels, 0).astype(np.uint8)
    grown = cv2.dilate(things, np.ones((2 * wide_px + 1, 2 * wide_px + 1), np.uint8))
    return np.where(grown > 0, grown, labels).astype(np.uint8)


def gradients_of(frames, wide_px=0, **slip):
    """Column `label_gradients` of frames whose labels slipped."""
    made = [picture_and_labels(seed) for seed in range(frames)]
    return np.stack([label_gradients(grey, moved(widened(labels, wide_px), **slip)) for grey, labels in made])


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
    assert day_labels(make_day(3, seed=1), 0.01) is None  # of a camera without semantics


@pytest.mark.parametrize("shift", [(-1, 0), (1, -1), (2, 0), (0, -2), (-2, 2), (3, 3), (0, 3), (-3, 0)])
def test_a_shift_of_whole_pixels_is_measured_with_its_sign_and_flagged(shift):
    offset = measure_label_offset(gradients_of(FRAMES, right_px=shift[0], down_px=shift[1]), BLOCKS)
    assert offset.is_beside
    # The picture lies where the labels came from.
    assert offset.shift_px == pytest.approx([-shift[0], -shift[1]], abs=0.35)


# Three per cent of a whole image's rows are 7 px at its ends; here 3 % of the columns are 5 px, 5 % of the rows 4.
@pytest.mark.parametrize(
    ("slip", "share", "axis", "half"), [("wider", 0.03, 0, WIDTH / 2), ("higher", 0.05, 1, HEIGHT / 2)]
)
def test_a_slip_of_scale_shows_at_the_ends_and_not_in_the_middle_and_is_not_taken_back(
    slip, share, axis, half
):
    offset = measure_label_offset(gradients_of(FRAMES, **{slip: share}), BLOCKS)
    assert offset.is_beside
    assert offset.ends_px[axis] == pytest.approx(-share * half, rel=0.35)
    assert abs(offset.shift_px[axis]) < 0.6
    assert day_labels(day(**{slip: share}), 1.0).moved_px is None


@pytest.mark.parametrize("wide_px", [1, 4])
def test_labels_too_wide_are_not_displaced_ones_where_the_skyline_is_in_place(wide_px):
    """Labels of a coarse network seemed beside their picture on seven of eight days."""
    offset = measure_label_offset(gradients_of(FRAMES, wide_px=wide_px), BLOCKS)
    assert not offset.is_beside
    assert np.abs(offset.shift_px).max() < 0.35
    shifted = measure_label_offset(gradients_of(FRAMES, wide_px=wide_px, down_px=1), BLOCKS)
    assert shifted.shift_px == pytest.approx([0, -1], abs=0.35)
    assert shifted.is_beside


def focal_px(rows):
    return rows[0].camera_K[1, 1] * rows[0].label_scale


def test_an_offset_beyond_the_limit_is_failed_by_name_and_the_labels_stay():
    rows = day(right_px=2)
    labels = day_labels(rows, 1.5 / focal_px(rows))
    assert labels.moved_px is None
    found = labels.judged(solution())
    (check,) = found.failed_checks["camera_lidar"]
    assert (check.fault, check.error) == ("labels_offset", None)
    assert "-2.0 +-" in check.sentence
    assert found.pairs["camera_lidar"].diagnostics["label_shift_u_px"] == pytest.approx(-2, abs=0.3)
    assert not found.failed_checks.get("lidar_radar")
    assert [o.label_offset_px for o in labels.in_place(rows)] == [(0.0, 0.0)] * FRAMES


def test_an_offset_within_the_limit_is_taken_back_and_its_sigma_is_the_records():
    rows = day(right_px=2)
    labels = day_labels(rows, 2.5 / focal_px(rows))
    assert labels.moved_px == pytest.approx([-2, 0], abs=0.3)
    assert labels.moved_px[1] == 0  # in place down the image
    assert {o.label_offset_px for o in labels.in_place(rows)} == {tuple(labels.moved_px.tolist())}
    found = labels.judged(solution())
    (check,) = found.failed_checks["camera_lidar"]
    assert check.fault == "labels_offset"
    assert not any(check.error)
    estimate = found.pairs["camera_lidar"]
    more = np.sqrt(np.diag(estimate.covariance) - 1e-6)
    assert more[1] == pytest.approx(labels.offset.shift_sigma_px[0] / focal_px(rows))
    assert more[0] == pytest.approx(labels.offset.open_px[1] / focal_px(rows))
    assert estimate.diagnostics["label_moved_u_px"] == labels.moved_px[0]


def test_scenes_that_disagree_leave_a_pixel_open_down_the_image_and_widen_pitch_by_it():
    gradients = gradients_of(FRAMES)
    gradients[::2, 2:4] = np.roll(gradients[::2, 2:4], 4, -1)
    rows = [
        replace(o, label_gradients=g, drive=i)
        for i, (o, g) in enumerate(zip(make_day(FRAMES, seed=1), gradients, strict=True))
    ]
    estimate = day_labels(rows, 0.01).judged(solution()).pairs["camera_lidar"]
    open_px = measure_label_offset(gradients, np.arange(FRAMES)).open_px
    assert open_px[0] == 0
    assert open_px[1] > 0.3
    more = np.sqrt(np.diag(estimate.covariance) - 1e-6)
    assert more[0] == pytest.approx(open_px[1] / focal_px(rows))
    assert more[1] == pytest.approx(open_px[0] / focal_px(rows))
    assert more[2:].max() < 1e-9

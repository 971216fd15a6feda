"""Gradients across label borders peak where the picture's border lies, by side of the foreground."""

import numpy as np
import pytest

from pipeline.perceive.labels import REACH_PX, label_gradients
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT

CAR, BUILDING, ROAD, SKY = 13, 2, 0, 10


def a_car(width=120, height=90, noise=0.0):
    labels = np.full((height, width), BUILDING, np.uint8)
    labels[30:60, 40:80] = CAR
    grey = np.where(labels == CAR, 50, 150) + np.random.default_rng(0).normal(0, noise, labels.shape)
    return np.clip(grey, 0, 255).astype(np.uint8), labels


@pytest.mark.parametrize(("right", "down"), [(0, 0), (3, 0), (-2, 0), (0, 4), (0, -1), (2, 3)])
def test_each_sides_maximum_lies_where_the_picture_s_border_does(right, down):
    grey, labels = a_car(noise=6.0)
    found = label_gradients(np.roll(grey, (down, right), (0, 1)), labels)
    for side, wanted in (
        (EDGE_RIGHT, right), (EDGE_LEFT, right), (EDGE_ABOVE, down), (EDGE_BELOW, down),
    ):  # fmt: skip
        assert found[side].sum(0).argmax() - REACH_PX == wanted


def test_labels_too_wide_move_opposite_sides_apart():
    grey, labels = a_car()
    labels[28:62, 38:82] = CAR
    peaks = label_gradients(grey, labels).sum(1).argmax(1) - REACH_PX  # no sky: the last two are empty
    assert peaks[EDGE_LEFT] == peaks[EDGE_ABOVE] == -2  # the foreground lies before the border
    assert peaks[EDGE_RIGHT] == peaks[EDGE_BELOW] == 2


def test_what_stands_before_the_sky_is_kept_apart():
    grey, labels = a_car()
    labels[labels == CAR] = SKY  # a hole in a building
    found = label_gradients(grey, labels)
    assert not found[:4].any()
    assert (found[4:].sum((1, 2)) > 0).all()
    # The building lies on the left of the hole's left border.
    assert found[4 + EDGE_LEFT].sum(1).argmax() < found[4 + EDGE_RIGHT].sum(1).argmax()

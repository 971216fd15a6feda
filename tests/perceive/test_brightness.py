"""Steps of brightness are found where they are, along rows and columns, and not where there are none."""

import numpy as np
import pytest

from pipeline.perceive.features import brightness_steps
from schemas.observations import STEP_BELOW, STEP_RIGHT

HEIGHT, WIDTH = 60, 90


def uniform(shade=120):
    return np.full((HEIGHT, WIDTH), shade, np.uint8)


@pytest.mark.parametrize("place_px", [30.0, 30.3, 30.7, 61.0])
@pytest.mark.parametrize("is_upright", [True, False])
def test_a_step_is_found_to_half_a_pixel_where_it_is_and_nowhere_else(place_px, is_upright):
    share = np.clip(np.arange(WIDTH) + 0.5 - place_px, 0.0, 1.0)  # pixel centres are at whole numbers
    grey = np.tile(np.round(60 + 90 * share), (HEIGHT, 1)).astype(np.uint8)
    bit, other = (STEP_RIGHT, STEP_BELOW) if is_upright else (STEP_BELOW, STEP_RIGHT)
    found = brightness_steps(grey if is_upright else np.ascontiguousarray(grey.T))
    along = found if is_upright else found.T
    assert not (along & other).any()
    rows, columns = np.nonzero(along & bit)
    assert len(np.unique(rows)) > 0.8 * HEIGHT
    assert np.abs(columns + 0.5 - place_px).max() <= 0.5


def test_a_pole_keeps_its_steps_where_another_border_crosses_it():
    # A gap there, at one height in all frames of a street, turned the camera by .2 deg at a sigma of .05.
    grey = uniform(50)
    grey[:30] = 230
    grey[:, 40:46] = 150
    steps = brightness_steps(grey)
    for column in (39, 45):
        assert ((steps[3:-3, column - 1 : column + 2] & STEP_RIGHT) > 0).any(axis=1).all()

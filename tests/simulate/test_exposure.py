"""What comes out of the optics becomes eight bits, whatever came in."""

import numpy as np

from pipeline.simulate.sensors.camera import _exposed


def test_pixels_beyond_black_and_white_are_black_and_white():
    linear = np.full((60, 80, 3), 0.2, np.float32)
    linear[:20], linear[40:] = -2.3e10, 2.3e10
    image = _exposed(linear, 1.5, 0.0, np.random.default_rng(0))
    assert (image[:18] == 0).all()
    assert (image[42:] == 255).all()
    assert ((image[25:35] > 60) & (image[25:35] < 220)).all()

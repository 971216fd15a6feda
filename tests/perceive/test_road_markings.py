"""Paint stands out of its ring, whatever the ring's own brightness; contrast stays within the road."""

import numpy as np

from pipeline.perceive.road_markings import lidar_markings, road_contrast


def test_paint_stands_out_of_rings_of_different_brightness():
    rng = np.random.default_rng(0)
    azimuth = np.tile(np.linspace(-0.5, 0.5, 400), 3)
    ring = np.repeat(np.arange(3, dtype=np.uint16), 400)
    radius = np.array([7.0, 10.0, 15.0])[ring]
    xyz = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(1200, -1.8)], -1)
    paint = np.abs(xyz[:, 1] - 1.0) < 0.1
    intensity = np.array([10.0, 30.0, 60.0])[ring] + 25 * paint + rng.normal(0, 1.5, 1200)
    xyz, intensity = xyz.astype(np.float32), intensity.astype(np.float32)
    for rings in (ring, None):
        marks = lidar_markings(xyz, intensity, rings, np.ones(1200, bool))
        bright = marks.xyz_m[marks.z > 6.0]
        assert len(bright) == np.count_nonzero(paint)
        assert (np.abs(bright[:, 1] - 1.0) < 0.1).all()
        assert len(marks.z) < 800  # plain road is thinned


def test_contrast_shows_a_line_and_nothing_outside_the_mask():
    grey = np.full((60, 400), 70, np.uint8)
    grey[:, 200:204] = 180
    grey[:, 350:] = 255
    mask = np.zeros(grey.shape, bool)
    mask[20:, 50:340] = True
    contrast = road_contrast(grey, mask)
    assert contrast.dtype == np.uint8
    assert (contrast[~mask] == 0).all()
    assert (contrast[25:55, 200:204] == 110).all()
    assert (contrast[25:55, 60:190] == 0).all()

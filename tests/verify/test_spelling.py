"""The same calibration, spelled otherwise, is the same calibration."""

import numpy as np

from pipeline.rig.se3 import exp_se3, inverse, log_se3
from pipeline.verify.one_log import on_grid


def test_digits_beyond_any_measurement_do_not_matter_and_the_pose_stays_where_it_is():
    rng = np.random.default_rng(4)
    alike = 0
    for _ in range(300):
        T = exp_se3(rng.normal(size=6))
        otherwise = T + rng.uniform(-3e-8, 3e-8, (4, 4)) * (np.arange(4)[:, None] < 3)
        alike += np.array_equal(on_grid(T), on_grid(otherwise))
        assert np.abs(log_se3(on_grid(T) @ inverse(T))).max() < 4e-4
    assert alike > 295

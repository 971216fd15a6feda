"""The radar's time offset: dips of the registration's cost beside slopes that have nothing to do with time."""

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar.schedule import SCHEDULE
from pipeline.calibrate.joint.lidar_radar.time_offset import dips


def test_a_slope_has_no_dip_wherever_it_leads():
    steps = np.arange(41.0)[:, None]
    slope = np.hstack([0.7 * steps, -2.0 * steps, 0 * steps])
    inner = slice(
        SCHEDULE.dt_dip_steps, -SCHEDULE.dt_dip_steps
    )  # at the ends half of the surroundings are missing
    assert np.allclose(dips(slope)[inner], 0.0)


@pytest.mark.parametrize("slope", [-3.0, 0.0, 3.0])
def test_a_dip_is_deepest_where_it_is_however_steep_the_slope(slope):
    steps = np.arange(61.0)
    cost = slope * steps - 20.0 * np.exp(-0.5 * ((steps - 37) / 1.2) ** 2)
    assert int(np.argmin(dips(cost[:, None])[:, 0])) == 37
    assert (int(np.argmin(cost)) == 37) == (slope == 0.0)  # which its lowest value would not show

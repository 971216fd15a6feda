"""In a jam the edges whose foreground lies below rise above the true pose, as on KITTI's; in a town they do not."""

import numpy as np
import pytest

from tests.benchmarks.studies.edge_sides import PITCH_DEG, SIDES, excess_over_pitch, terms_of
from tests.makers.simulated_days import simulated_day

SIGMA_PX = 3.0


def curves_of(folder, environment):
    day = simulated_day(folder, frames=8, environment=environment, seed=22)
    terms = terms_of(day.observations, day.truth["camera_lidar"])
    found = excess_over_pitch(terms, day.truth["camera_lidar"], day.told["dt_camera_lidar_s"], SIGMA_PX)
    assert min(np.bincount(terms.edges.side, minlength=len(SIDES))) > 100
    return {side: excess / excess.max() for side, excess in found.items()}


@pytest.mark.slow
@pytest.mark.parametrize(("environment", "rises"), [("jam", True), ("urban", False)])
def test_what_shines_through_windows_rises_where_nothing_else_does(tmp_path, environment, rises):
    curves = curves_of(tmp_path, environment)
    far = np.isin(PITCH_DEG, [1.0, 1.25, 1.5])
    assert curves["above"][far].max() < 0.3
    assert abs(PITCH_DEG[curves["above"].argmax()]) <= 0.25
    assert (curves["below"][far].min() > 0.85) == rises
    assert (PITCH_DEG[curves["below"].argmax()] >= 0.5) == rises

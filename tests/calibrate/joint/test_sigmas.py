"""Sigmas of `joint` are neither too small nor too wide: doubled or halved ones would fail here.

The statistic is the root mean square of error over sigma, over the degrees of freedom that a day determines (and the
radar's time offset). It would be 1 where sigmas held noise only. Theirs also hold bias floors, for what real drives
have and these scenes have not, so it is smaller here; the bounds are a third either way of what other seeds showed
(100 to 119 for the radar: 0.37, 0.41, 0.31, 0.35 by fives; 100 to 109 for the camera, measured with 0.7.0: 0.23 and
0.33 by fives).

What a kernel calls is a weak symbol to numba: each caller holds a copy, and the linker takes whichever it met first,
the callee's own where it was just compiled, a caller's where it was loaded. With fast arithmetic the copies round
differently, so such a callee is inlined: one record from the same inputs, by whatever process.
"""

import importlib
import pkgutil

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

import pipeline.objective
import pipeline.perceive
from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.core.config import SolveConfig
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import change_between, change_covariance, perturb_exactly
from tests.makers.camera_lidar import estimate_camera_lidar
from tests.makers.radar_scenes import DT_S, T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR
from tests.makers.traced_scenes import SPARSE, T_TRUE, traced_day

SIGMA_RAD, SIGMA_M = float(np.radians(2.0)), 0.05
DAYS = range(200, 205)
CAMERA_DT_S = 0.02


def radar_normalised(seed):
    rng = np.random.default_rng(seed)
    prior = Prior(
        T_CAMERA_LIDAR, perturb_exactly(T_LIDAR_RADAR, np.radians(1.5), 0.04, rng), SIGMA_RAD, SIGMA_M
    )
    found = estimate_lidar_radar(street_day(20, seed=seed), prior, SolveConfig(), rng)
    offset = (found.time_offset_s - DT_S) / found.time_offset_sigma_s
    return [*normalised(found, T_LIDAR_RADAR), offset]


def camera_normalised(seed):
    rng = np.random.default_rng(seed)
    prior = Prior(perturb_exactly(T_TRUE, np.radians(1.5), 0.04, rng), np.eye(4), SIGMA_RAD, SIGMA_M)
    day = traced_day(SPARSE, 8, seed=seed, dt_s=CAMERA_DT_S)
    return normalised(estimate_camera_lidar(day, prior, SolveConfig(), rng), T_TRUE)


def normalised(estimate, T_true):
    """Error over sigma of every determined degree of freedom."""
    sigma = np.sqrt(np.diag(change_covariance(estimate.T, estimate.covariance)))
    z = change_between(T_true, estimate.T) / sigma
    return z[estimate.observable]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of_day", "usual"),
    [(radar_normalised, 0.36), (camera_normalised, 0.28)],
    ids=["lidar-radar", "camera-lidar"],
)
def test_errors_are_as_large_as_their_sigmas_say_neither_larger_nor_smaller(of_day, usual):
    z = np.concatenate([of_day(seed) for seed in DAYS])
    assert len(z) >= 3 * len(DAYS)
    assert np.abs(z).max() < 3.5

    def is_honest(sigma_factor):
        return usual / 1.33 < np.sqrt(np.mean(np.square(z / sigma_factor))) < usual * 1.33

    assert is_honest(1.0), np.sqrt(np.mean(np.square(z)))
    assert not is_honest(2.0)  # sigmas twice as wide
    assert not is_honest(0.5)  # half as wide


def kernels_of(*packages):
    for package in packages:
        for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            for value in vars(importlib.import_module(found.name)).values():
                if isinstance(value, Dispatcher) and value.__module__ == found.name:
                    yield value


def called_by(kernel):
    values = (kernel.py_func.__globals__.get(name) for name in kernel.py_func.__code__.co_names)
    return {value for value in values if isinstance(value, Dispatcher)}


def is_inlined(kernel):
    return kernel.targetoptions.get("forceinline") or kernel.targetoptions.get("inline") == "always"


def test_what_a_kernel_calls_with_fast_arithmetic_is_inlined():
    called = set().union(*map(called_by, kernels_of(pipeline.objective, pipeline.perceive)))
    fast = {k for k in called if k.targetoptions.get("fastmath")}
    assert len(fast) > 5
    assert [k.__name__ for k in fast if not is_inlined(k)] == []

"""A process that compiles the kernels finds what a process finds that loads them: one record from the same inputs.

What a kernel calls is a weak symbol to numba: each caller holds a copy, and the linker takes whichever it met first,
the callee's own where it was just compiled, a caller's where it was loaded. With fast arithmetic the copies round
differently, so such a callee is inlined.
"""

import importlib
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

import pipeline.objective
import pipeline.perceive
from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.core.config import SolveConfig
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import perturb_exactly
from tests.makers.camera_lidar import estimate_camera_lidar
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR
from tests.makers.traced_scenes import SPARSE, T_TRUE, traced_day

REPO = Path(__file__).resolve().parents[3]


def estimates():
    """Every number of two small estimations, as text to the last digit."""
    T, config = perturb_exactly(T_TRUE, np.radians(1.0), 0.03, np.random.default_rng(2)), SolveConfig()
    prior = Prior(T, np.eye(4), float(np.radians(2.0)), 0.05)
    seen = estimate_camera_lidar(traced_day(SPARSE, 6, seed=3), prior, config, np.random.default_rng(5))
    T = perturb_exactly(T_LIDAR_RADAR, np.radians(2.0), 0.1, np.random.default_rng(0))
    prior = Prior(T_CAMERA_LIDAR, T, float(np.radians(2.0)), 0.05)
    ranged = estimate_lidar_radar(street_day(12), prior, config, np.random.default_rng(3))
    return [
        (
            e.T.tolist(),
            e.covariance.tolist(),
            e.time_offset_s,
            e.time_offset_sigma_s,
            sorted(e.diagnostics.items()),
        )
        for e in (seen, ranged)
    ]


@pytest.mark.slow
def test_a_process_that_compiles_the_kernels_finds_what_one_finds_that_loads_them(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(REPO)}
    command = [
        sys.executable,
        "-c",
        "from tests.calibrate.joint.test_compiled_or_loaded import estimates; print(estimates())",
    ]

    def found():
        return subprocess.run(
            command, env=environment, cwd=REPO, check=True, capture_output=True, text=True
        ).stdout

    compiled = found()
    kernels = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}
    loaded = found()
    assert kernels == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}
    assert len(kernels) > 5
    assert loaded == compiled


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

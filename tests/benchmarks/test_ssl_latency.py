"""How long one frame takes and how large the file is: three passes with rendering, on two threads."""

import time

import numpy as np
import pytest

from pipeline.learn.export.onnx_file import export_onnx
from pipeline.learn.infer.single_frame import SingleFrameCalibrator
from pipeline.learn.network.calibration_network import build_network
from pipeline.learn.sample.camera_maps import class_likelihood
from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.layout import NetworkConfig
from pipeline.learn.sample.rendering import FrameSensors
from pipeline.rig.cameras import Camera

GOAL_MS = 40.0
BUSY = 6.0  # a shared machine: the goal is for idle cores; three processes on two were seen to take three times as long
T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.2], [1, 0, 0, 0], [0, 0, 0, 1]])


def full_frame():
    """As many points as table training holds."""
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-0.6, 0.6, 8192), rng.uniform(-0.27, 0.16, 8192)
    distance = rng.uniform(5, 70, 8192)
    xyz = distance * np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    features = np.stack(
        [rng.random(8192), rng.normal(0, 1, 8192), rng.random(8192) < 0.1, elevation < -0.05], -1
    )
    lidar = xyz.T.astype(np.float32)
    radar = lidar[rng.integers(0, 8192, 384)]
    camera = rng.random((4, 96, 192)).astype(np.float32)
    labels = rng.integers(0, 19, (470, 912)).astype(np.uint8)
    K = np.array([[450.0, 0, 911.5], [0, 450.0, 469.5], [0, 0, 1.0]])
    classes = class_likelihood(labels, Camera("equidistant", K, np.zeros(4), 1824, 940), Grid())
    return FrameSensors(
        camera,
        lidar,
        features.astype(np.float32),
        radar,
        rng.random((384, 3)).astype(np.float32),
        True,
        classes,
    )


@pytest.mark.parametrize("kind", ["matching", "concat", "classes"])
def test_three_passes_over_one_frame_stay_in_their_budget(kind, tmp_path, capsys, record):
    architecture = "concat" if kind == "concat" else "matching"
    config = NetworkConfig(architecture, takes_classes=kind == "classes")
    path = export_onnx(build_network(config), tmp_path / "model.onnx")
    calibrator, sensors = SingleFrameCalibrator(path, threads=2), full_frame()
    calibrator.estimate(sensors, T_CAMERA_LIDAR, np.eye(4))  # compiles
    wall, cpu = [], []
    for _ in range(10):
        began, busy = time.perf_counter(), time.process_time()
        calibrator.estimate(sensors, T_CAMERA_LIDAR, np.eye(4), iterations=3)
        wall.append(1e3 * (time.perf_counter() - began))
        cpu.append(1e3 * (time.process_time() - busy))
    with capsys.disabled():
        print(f"\n{kind}: 3 passes {min(wall):.0f} ms at best, {np.median(wall):.0f} ms median, "
              f"{min(cpu):.0f} ms of CPU; {path.stat().st_size / 1e6:.2f} MB")  # fmt: skip
    what = "ms for one frame through the network on two threads: three passes with rendering, best of ten"
    record(f"ssl_{kind}_frame_ms", min(wall), what, GOAL_MS)
    assert min(wall) < GOAL_MS * BUSY
    assert path.stat().st_size <= 2_500_000

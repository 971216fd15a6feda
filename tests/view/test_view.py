"""A vehicle-day in 3D: what is drawn is where the poses have it, and a machine that cannot draw says what it lacks."""

import ctypes
import json
import os
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from shutil import which

import cv2
import numpy as np
import pytest

from pipeline.core.errors import MissingLibraryError
from pipeline.rig.se3 import inverse, transform_points
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from pipeline.view.layers import Dots, Name, Picture, Rig, Shown, Strokes, layers_of, read_moment
from pipeline.view.system import require_renderer
from schemas.calibrations import CALIBRATIONS
from schemas.captures import Image, Scan, Sweep
from schemas.moments import MOMENTS, PERCEIVED
from tests.export.test_foxglove import frame, observation
from tests.export.test_foxglove_rig import DAY, SENSORS, write
from tests.makers.rig_records import rig_records

REPO = Path(__file__).resolve().parent.parent.parent
CALL = ["view", "--vehicle", DAY.vehicle, "--day", DAY.day]
# T_car_camera of a camera at the origin that looks ahead.
AHEAD = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
RED, BLUE = (255, 0, 0), (0, 0, 255)


def can_draw():
    try:
        require_renderer()
    except MissingLibraryError:
        return False
    return find_spec("open3d") is not None


drawing = pytest.mark.skipif(not can_draw(), reason="needs the extra [view] and a Vulkan driver")


def image():
    """Left half red, right half blue; 90 deg wide."""
    rgb = np.zeros((100, 200, 3), np.uint8)
    rgb[:, :100], rgb[:, 100:] = RED, BLUE
    K = np.array([[100.0, 0, 99.5], [0, 100, 49.5], [0, 0, 1]])
    return Image(
        moment=0, stamp_ns=0, image_width_px=200, image_height_px=100, camera_model="plumb_bob", camera_K=K,
        camera_D=np.zeros(0), image=cv2.imencode(".png", rgb[..., ::-1])[1].tobytes(), image_format="png",
        labels_png=None, detection_boxes_px=None, detection_classes=None, detection_scores=None,
    )  # fmt: skip


def sweep(xyz):
    x, y, z = np.array(xyz, np.float32).T
    return Sweep(
        moment=0, stamp_ns=0, lidar_x_m=x, lidar_y_m=y, lidar_z_m=z, lidar_intensity=None, lidar_ring=None,
        lidar_time_s=None, lidar_deskewed=False,
    )  # fmt: skip


def scan(xyz, range_rate_mps):
    x, y, z = np.array(xyz, np.float32).T
    return Scan(
        moment=0, stamp_ns=0, radar_x_m=x, radar_y_m=y, radar_z_m=z,
        radar_range_rate_mps=np.array(range_rate_mps, np.float32), radar_power_db=None, radar_has_elevation=True,
        doppler_period_mps=None,
    )  # fmt: skip


def rig(**poses):
    kinds = {"front": "camera", "top": "lidar", "nose": "radar"}
    return Rig(kinds, np.eye(4), {"calibrated": poses, "prior": poses}, {"front": "held"})


def scene():
    """Points left and right ahead and one behind, seen by a camera; a radar that sits 2 m ahead, turned to the left."""
    T_nose = np.array([[0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    captures = {
        "front": image(),
        "top": sweep([[10, 3, 0], [10, -3, 0], [-10, 0, 0]]),
        "nose": scan([[10, 0, 0], [5, 0, 0]], [-4.0, 0.0]),
    }
    return Shown(0, captures, {}), rig(front=AHEAD, top=np.eye(4), nose=T_nose)


def drawn(turned=None, **how):
    shown, sensors = scene()
    return layers_of(shown, sensors, sensors.placed("calibrated", turned, **how))


def test_a_point_has_the_colour_of_the_camera_that_sees_it_and_grey_where_none_does():
    [cloud] = [x for x in drawn() if isinstance(x, Dots) and x.part == "sweeps"]
    np.testing.assert_allclose(cloud.rgb[:2] * 255, [RED, BLUE])
    assert np.ptp(cloud.rgb[2]) < 0.1


def test_what_approaches_has_an_arrow_towards_the_radar_and_what_stands_has_none():
    dots, arrows = (x for x in drawn() if x.part == "radar")
    np.testing.assert_allclose(dots.xyz, [[2, 10, 0], [2, 5, 0]], atol=1e-9)
    shaft = arrows.ends[0]
    np.testing.assert_allclose(shaft[0], [2, 10, 0], atol=1e-9)
    assert shaft[1, 1] < 10
    assert shaft[1, 0] == pytest.approx(2)
    assert len(arrows.ends) == 3  # one shaft, two barbs


def test_the_picture_lies_on_the_rays_of_the_camera_three_metres_away():
    [picture] = [x for x in drawn() if isinstance(x, Picture)]
    np.testing.assert_allclose(np.linalg.norm(picture.xyz, axis=1), 3.0)
    uv, _ = read_camera().project(transform_points(inverse(AHEAD), picture.xyz))
    np.testing.assert_allclose(uv / [199, 99], picture.uv, atol=1e-6)


def read_camera():
    from pipeline.rig.cameras import camera_of

    return camera_of(image())


def test_sensors_are_named_with_what_the_record_says():
    names = {x.text: x.xyz.tolist() for x in drawn() if isinstance(x, Name)}
    assert names == {"front (held)": [0, 0, 0], "top": [0, 0, 0], "nose": [2, 0, 0]}


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """The day of a rig with two cameras and two radars."""
    lake = Lake.at(tmp_path_factory.mktemp("rig") / "lake")
    write(lake, MOMENTS, frame)
    write(lake, PERCEIVED, observation)
    commit_records(lake, CALIBRATIONS, rig_records("van", 1, np.random.default_rng(4)))
    return lake


def test_a_moment_has_all_sensors_of_the_rig_and_boxes_of_its_clusters(lake):
    shown = read_moment(lake, DAY)
    assert set(shown.captures) == set(SENSORS) == set(shown.found)
    T = {name: AHEAD if kind == "camera" else np.eye(4) for name, (kind, _) in SENSORS.items()}
    layers = layers_of(shown, Rig({n: k for n, (k, _) in SENSORS.items()}, np.eye(4), {}, {}), T)
    [boxes] = [x for x in layers if isinstance(x, Strokes) and x.part == "boxes"]
    corners = [shown.found["top"].lidar_cluster_min_m, shown.found["top"].lidar_cluster_max_m]
    low, high = (
        np.min(corners, axis=0),
        np.max(corners, axis=0),
    )  # the day is made up: its boxes have no order
    assert len(boxes.ends) == 12 * len(low)
    np.testing.assert_allclose(boxes.ends.min(axis=(0, 1)), low.min(axis=0), rtol=1e-6)
    np.testing.assert_allclose(boxes.ends.max(axis=(0, 1)), high.max(axis=0), rtol=1e-6)


def run(*args, env=None, path=()):
    own = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    places = [str(p) for p in (*path, REPO)] + [os.environ.get("PYTHONPATH", "")]
    own |= {"PYTHONPATH": os.pathsep.join(places)} | (env or {})
    command = [sys.executable, "-m", "jobs.cli", *map(str, args)]
    return subprocess.run(command, env=own, capture_output=True, text=True, check=False, cwd=REPO)


@pytest.mark.parametrize(
    ("raised", "env", "more", "words"),
    [
        ("libGL.so.1: cannot open shared object file: No such file", {}, ["--out", "a.png"], "libgl1"),
        ("", {"VK_DRIVER_FILES": "/no", "VK_ICD_FILENAMES": "/no"}, ["--out", "a.png"], "mesa-vulkan-drivers"),
        ("", {}, [], "--out FILE.png"),
    ],
)  # fmt: skip
def test_a_machine_without_what_open3d_needs_is_told_what_to_do(tmp_path, raised, env, more, words):
    if words.startswith("--out"):
        try:
            ctypes.CDLL("libX11.so.6")
        except OSError:
            pytest.skip("needs libX11, to ask for a display")
    # An open3d that only fails as the real one does where a library is missing.
    (tmp_path / "open3d").mkdir()
    (tmp_path / "open3d" / "__init__.py").write_text(f"if {raised!r}: raise ImportError({raised!r})\n")
    done = run(*CALL, "--lake", tmp_path / "no", *more, env=env, path=[tmp_path])
    assert done.returncode == 2, done.stderr
    assert words in json.loads(done.stdout.splitlines()[-1])["reason"]


@drawing
def test_out_draws_prior_and_calibrated_side_by_side_without_a_display(lake, tmp_path):
    done = run(*CALL, "--lake", lake.root, "--out", tmp_path / "a.png")
    assert done.returncode == 0, done.stderr
    [line] = done.stdout.splitlines()  # what the renderer prints goes elsewhere
    assert json.loads(line)["without_pose"] == []
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture.shape == (900, 1600, 3)
    lit = picture.max(axis=2) > 60
    assert min(lit[:, :800].sum(), lit[:, 800:].sum()) > 3000


@drawing
@pytest.mark.skipif(which("Xvfb") is None, reason="needs Xvfb (apt-get install xvfb)")
def test_the_window_shows_the_day_and_changes_with_its_keys_and_its_slider(lake):
    display = f":{90 + os.getpid() % 900}"
    screen = subprocess.Popen(
        ["Xvfb", display, "-screen", "0", "1400x860x24"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        time.sleep(2)
        command = [sys.executable, str(Path(__file__).parent / "drive_window.py"), str(lake.root)]
        env = os.environ | {"DISPLAY": display}
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=1800, check=False)
    finally:
        screen.terminate()
        screen.wait()
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == {
        "states": ["calibrated", "prior"], "moments": [0, 1], "turned": ["front", "yaw", 3.0], "ended": True,
    }  # fmt: skip

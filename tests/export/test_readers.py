"""Exported files open in the programs they are for, and mean the same there."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import xacro
import yaml

from pipeline.export.files import write_files, written_files
from pipeline.export.formats import format_named
from tests.export.real_readers import READERS
from tests.export.test_many_sensors import five
from tests.makers.calibrations import calibration, random_transform
from tests.makers.rig_records import T_TOP


@pytest.fixture
def sent():
    rng = np.random.default_rng(5)
    return calibration(random_transform(rng), random_transform(rng))


def exported(name, sent, folder):
    write_files(written_files(format_named(name), sent, folder / name))
    return folder / name


def test_autoware_s_kit_expands_with_xacro_to_the_poses_of_its_yaml(tmp_path):
    sent = five()
    folder, car = exported("autoware", sent, tmp_path), tmp_path / "car.xacro"
    car.write_text(f"""<robot name="car" xmlns:xacro="http://ros.org/wiki/xacro">
<xacro:include filename="{folder}/sensor_kit.xacro"/><link name="base_link"/>
<xacro:sensor_kit_macro parent="base_link" x="0.9" y="0" z="2" roll="0" pitch="0" yaw="0" config_dir="{folder}"/>
</robot>""")
    expanded = format_named("urdf").tree({"car": xacro.process_file(str(car)).toxml().encode()})
    own = format_named("autoware").tree({"k.yaml": (folder / "sensor_kit_calibration.yaml").read_bytes()})
    T_link_optical = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    for sensor, T in T_TOP.items():
        optical = T_link_optical if sensor in ("front", "left") else np.eye(4)
        for tree in (expanded, own):
            found = tree.lookup("top", sent.names.of(sensor))
            np.testing.assert_allclose(found @ optical, T, atol=1e-12)


def test_ros_2_launch_files_start_a_publisher_per_pose(sent, monkeypatch):
    """With stand-ins for launch and launch_ros, which no package index has."""
    nodes = []
    launch, actions = ModuleType("launch"), ModuleType("launch_ros.actions")
    launch.LaunchDescription = list
    actions.Node = lambda **given: nodes.append(given) or given
    for name, module in {
        "launch": launch,
        "launch_ros": ModuleType("launch_ros"),
        "launch_ros.actions": actions,
    }.items():
        monkeypatch.setitem(sys.modules, name, module)
    files = format_named("ros2").write(sent)
    space = {}
    exec(compile(files["static_transforms.launch.py"], "launch.py", "exec"), space)
    assert len(space["generate_launch_description"]()) == len(nodes) == 2
    in_yaml = [entry["node"] for entry in yaml.safe_load(files["static_transforms.launch.yaml"])["launch"]]
    for node, other in zip(nodes, in_yaml, strict=True):
        assert (node["package"], node["executable"]) == (other["pkg"], other["exec"])
        assert node["arguments"] == other["args"].split()
        assert all(isinstance(a, str) for a in node["arguments"])


def test_the_camera_chain_passes_kalibr_s_own_checks(sent):
    """As CameraParameters of kalibr_common/ConfigReader.py makes them, with PyYAML."""
    data = yaml.safe_load(format_named("kalibr").write(sent)["camchain.yaml"])
    assert list(data) == ["cam0"]  # Kalibr counts the keys as cameras
    cam = data["cam0"]
    assert isinstance(cam["rostopic"], str)
    assert cam["camera_model"] == "pinhole"
    assert [type(v) for v in cam["intrinsics"]] == [float] * 4
    assert min(cam["intrinsics"]) > 0
    assert len(cam["distortion_coeffs"]) == {"radtan": 4, "equidistant": 4}[cam["distortion_model"]]
    assert [type(v) for v in cam["resolution"]] == [int, int]
    np.testing.assert_array_equal(cam["T_cam_lidar"], sent.pairs["camera_lidar"].T)


@pytest.fixture(scope="module")
def read_by_others(tmp_path_factory):
    python = os.environ.get("BORESIGHT_READERS")
    if not python:
        pytest.skip("BORESIGHT_READERS names no Python with the other programs: make readers")
    rng = np.random.default_rng(6)
    sent, folder = calibration(random_transform(rng), random_transform(rng)), tmp_path_factory.mktemp("files")
    for name in READERS:
        exported(name, sent, folder)
    script = Path(__file__).parent / "real_readers.py"
    done = subprocess.run([python, script, folder], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return sent, json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_the_program_that_a_format_is_for_finds_the_same_transforms(name, read_by_others):
    sent, found = read_by_others
    for pair in ("camera_lidar", "lidar_radar"):
        np.testing.assert_allclose(
            found[name][pair], sent.pairs[pair].T, atol=1e-12, err_msg=found[name]["reader"]
        )

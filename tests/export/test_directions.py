"""Every format against numbers worked out in the head: an inverted transform or a swapped quaternion fails here.

The camera looks forward, 1 m ahead of the lidar and 0.5 m above it; the radar is 2 m ahead, 0.25 m left, 1 m below, and
looks to the left; the lidar stands 2 m above the car's base.
"""

import io
import json
import re

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from pipeline.export.calibration import FrameNames
from pipeline.export.formats import FORMATS, format_named
from tests.makers.calibrations import T_BASE_LIDAR, T_CAMERA_LIDAR, T_LIDAR_RADAR, calibration

# By format: file, and what must stand in it, numbers to ten digits. Nothing here was made by the code under test.
EXPECTED = {
    "ros2": {
        "static_transforms.launch.py": [
            ("['--x', '0', '--y', '0', '--z', '2', '--qw', '1', '--qx', '0', '--qy', '0', '--qz', '0', "
            "'--frame-id', 'base_link', '--child-frame-id', 'lidar']"),
            ("['--x', '1', '--y', '0', '--z', '0.5', '--qw', '0.5', '--qx', '-0.5', '--qy', '0.5', '--qz', '-0.5', "
            "'--frame-id', 'lidar', '--child-frame-id', 'camera']"),
        ],
        "static_transforms.launch.yaml": [
            ("args: --x 2 --y 0.25 --z -1 --qw 0.7071067812 --qx 0 --qy 0 --qz 0.7071067812 "
            "--frame-id lidar --child-frame-id radar")
        ],
    },
    "urdf": {
        "sensors.urdf": [
            '<origin xyz="1 0 0.5" rpy="-1.570796327 0 -1.570796327" /><parent link="lidar" /><child link="camera" />',
            '<origin xyz="2 0.25 -1" rpy="0 0 1.570796327" /><parent link="lidar" /><child link="radar" />',
            '<origin xyz="0 0 2" rpy="0 0 0" /><parent link="base_link" /><child link="lidar" />',
        ]
    },
    "xacro": {
        "sensors.urdf.xacro": [
            '<origin xyz="0 0 2" rpy="0 0 0" /><parent link="${parent}" /><child link="lidar" />',
            '<origin xyz="2 0.25 -1" rpy="0 0 1.570796327" /><parent link="lidar" /><child link="radar" />',
        ]
    },
    "autoware": {
        # The link of a camera that looks forward is not turned.
        "sensor_kit_calibration.yaml": [
            "camera: x: 1 y: 0 z: 0.5 roll: 0 pitch: 0 yaw: 0",
            "radar: x: 2 y: 0.25 z: -1 roll: 0 pitch: 0 yaw: 1.570796327",
            "lidar: x: 0 y: 0 z: 0 roll: 0 pitch: 0 yaw: 0",
        ],
        "sensors_calibration.yaml": [
            "base_link: sensor_kit_base_link: x: 0 y: 0 z: 2 roll: 0 pitch: 0 yaw: 0"
        ],
    },
    "kitti": {
        "calib.txt": [
            "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0.5 1 0 0 -1",
            "Tr_radar_to_velo: 0 -1 0 2 1 0 0 0.25 0 0 1 -1",
            "Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 -2",
            "P2: 800 0 640.5 0 0 801 360.25 0 0 0 1 0",
            "R0_rect: 1 0 0 0 1 0 0 0 1",
        ]
    },
    "nuscenes": {
        "calibrated_sensor.json": [
            '"translation": [ 1, 0, 2.5 ], "rotation": [ 0.5, -0.5, 0.5, -0.5 ]',
            '"translation": [ 2, 0.25, 1 ], "rotation": [ 0.7071067812, 0, 0, 0.7071067812 ], "camera_intrinsic": []',
        ]
    },
    "t4": {
        "calibrated_sensor.json": [
            '"translation": [ 1, 0, 2.5 ], "rotation": [ 0.5, -0.5, 0.5, -0.5 ]',
            '"camera_distortion": [ -0.31, 0.1, 0.001, -0.002, 0 ]',
        ]
    },
    "kalibr": {
        "camchain.yaml": [
            "T_cam_lidar: - [0, -1, 0, 0] - [0, 0, -1, 0.5] - [1, 0, 0, -1] - [0, 0, 0, 1]",
            "T_cam_radar: - [-1, 0, 0, -0.25] - [0, 0, -1, 1.5] - [0, -1, 0, 1] - [0, 0, 0, 1]",
            ("intrinsics: [800, 801, 640.5, 360.25] distortion_model: radtan "
            "distortion_coeffs: [-0.31, 0.1, 0.001, -0.002]"),
        ]
    },
    "opencv": {
        "calibration.yaml": [
            ("T_camera_lidar: !!opencv-matrix rows: 4 cols: 4 dt: d "
            "data: [ 0, -1, 0, 0, 0, 0, -1, 0.5, 1, 0, 0, -1, 0, 0, 0, 1 ]"),
            "data: [ 0, -1, 0, 2, 1, 0, 0, 0.25, 0, 0, 1, -1, 0, 0, 0, 1 ]",
        ]
    },
}  # fmt: skip
_NUMBER = re.compile(r"-?\d+\.\d*(?:e[+-]?\d+)?|-?\b\d+(?=[,.\s])")


def _plain(text):
    """Numbers to ten digits, white space as single blanks, none between XML tags."""
    text = _NUMBER.sub(lambda m: f"{round(float(m[0]), 10) + 0.0:.10g}", text)
    return re.sub(r">\s+<", "><", " ".join(text.split()))


@pytest.mark.parametrize("name", EXPECTED)
def test_a_format_says_where_the_sensors_are_as_worked_out_in_the_head(name):
    files = format_named(name).write(calibration(T_base_lidar=T_BASE_LIDAR))
    for file, parts in EXPECTED[name].items():
        text = _plain(files[file].decode())
        for part in parts:
            assert part in text, f"{file}\n{part}\n{text}"


def test_tf_static_says_the_same_to_another_reader_of_ros_2():
    content = format_named("tf-static").write(calibration(T_base_lidar=T_BASE_LIDAR))["tf_static.mcap"]
    reader = make_reader(io.BytesIO(content), decoder_factories=[DecoderFactory()])
    [(schema, channel, _, message)] = reader.iter_decoded_messages()
    assert (schema.name, channel.topic) == ("tf2_msgs/msg/TFMessage", "/tf_static")
    assert "durability: 1" in channel.metadata["offered_qos_profiles"]
    found = {}
    for t in message.transforms:
        q, p = t.transform.rotation, t.transform.translation
        found[t.header.frame_id, t.child_frame_id] = [p.x, p.y, p.z, q.w, q.x, q.y, q.z]
    half = np.sqrt(0.5)
    wanted = {
        ("base_link", "lidar"): [0, 0, 2, 1, 0, 0, 0],
        ("lidar", "camera"): [1, 0, 0.5, 0.5, -0.5, 0.5, -0.5],
        ("lidar", "radar"): [2, 0.25, -1, half, 0, 0, half],
    }
    assert found.keys() == wanted.keys()
    for edge, values in wanted.items():
        np.testing.assert_allclose(found[edge], values, atol=1e-12)
    [metadata] = reader.iter_metadata()
    assert json.loads(metadata.metadata["provenance"])["pairs"]["camera_lidar"]["status"] == "accepted"


# The same sensors as other programs would have written them.
# The camera's quaternion alone would not tell x y z w from w x y z (it is its own negative then): the radar's does.
FOREIGN = {
    "ros2": {
        "a.launch.yaml": """
launch:
- node: {pkg: tf2_ros, exec: static_transform_publisher, args: --x 1 --y 0 --z 0.5 --qx -0.5 --qy 0.5 --qz -0.5
    --qw 0.5 --frame-id /lidar --child-frame-id /camera}
- node: {pkg: rviz2, exec: rviz2}
- node: {pkg: tf2_ros, exec: static_transform_publisher, args: --x 2 --y 0.25 --z -1 --qx 0 --qy 0
    --qz 0.70710678118654757
    --qw 0.70710678118654757 --frame-id lidar --child-frame-id radar}
"""
    },
    "urdf": {
        "a.urdf": """<robot name="r"><link name="kit"/><link name="lidar"/><link name="camera"/><link name="radar"/>
<joint name="a" type="fixed"><origin xyz="0 0 1"/><parent link="kit"/><child link="lidar"/></joint>
<joint name="b" type="fixed"><origin xyz="1 0 1.5" rpy="-1.5707963267948966 0 -1.5707963267948966"/>
  <parent link="kit"/><child link="camera"/></joint>
<joint name="c" type="fixed"><origin rpy="0 0 1.5707963267948966" xyz="2 .25 0"/>
  <parent link="kit"/><child link="radar"/>
</joint><joint name="w" type="continuous"><parent link="kit"/><child link="wheel"/></joint></robot>"""
    },
    "autoware": {
        "a.yaml": """
sensor_kit_base_link:
  camera: {x: 1, y: 0, z: 1.5, roll: 0, pitch: 0, yaw: 0}   # Design Value
  lidar: {x: 0, y: 0, z: 1.0, roll: 0, pitch: 0, yaw: 0}
  radar: {x: 2.0, y: 0.25, z: 0, roll: 0, pitch: 0, yaw: 1.5707963267948966}
"""
    },
    "kitti": {
        "a.txt": "P2: 1 0 0 0 0 1 0 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\ncalib_time: 09-Jan-2012 13:57:47\n"
        "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0.5 1 0 0 -1\nTr_radar_to_velo: 0 -1 0 2 1 0 0 0.25 0 0 1 -1\n\n"
    },
    "vod": {
        "lidar/calib.txt": "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0.5 1 0 0 -1\n",
        "radar/calib.txt": "Tr_velo_to_cam: -1 0 0 -0.25 0 0 -1 1.5 0 -1 0 1\n",
    },
    "nuscenes": {
        "v1/sensor.json": '[{"token": "c", "channel": "camera", "modality": "camera"},'
        '{"token": "l", "channel": "lidar", "modality": "lidar"},'
        '{"token": "r", "channel": "radar", "modality": "radar"}]',
        "v1/calibrated_sensor.json": """[
{"token": "1", "sensor_token": "c", "translation": [1, 0, 2.5], "rotation": [0.5, -0.5, 0.5, -0.5]},
{"token": "2", "sensor_token": "l", "translation": [0, 0, 2], "rotation": [1, 0, 0, 0]},
{"token": "3", "sensor_token": "r", "translation": [2, 0.25, 1],
 "rotation": [0.7071067811865476, 0, 0, 0.7071067811865476]}]""",
    },
    "kalibr": {
        "a.yaml": "cam0:\n  T_cam_lidar:\n  - [0, -1, 0, 0]\n  - [0, 0, -1, 0.5]\n  - [1, 0, 0, -1]\n  - [0, 0, 0, 1]\n"
        "  T_cam_radar: [[-1, 0, 0, -0.25], [0, 0, -1, 1.5], [0, -1, 0, 1], [0, 0, 0, 1]]\n"
    },
    "opencv": {
        "a.yaml": "%YAML:1.0\n---\nT_camera_lidar: !!opencv-matrix\n   rows: 3\n   cols: 4\n   dt: d\n"
        "   data: [ 0., -1., 0., 0., 0., 0., -1., .5, 1., 0., 0., -1. ]\nT_lidar_radar: !!opencv-matrix\n   rows: 4\n"
        "   cols: 4\n   dt: f\n   data: [ 0., -1., 0., 2., 1., 0., 0., .25, 0., 0., 1., -1., 0., 0., 0., 1. ]\n"
    },
}


@pytest.mark.parametrize("name", FOREIGN)
def test_files_of_other_programs_are_read_in_the_direction_that_they_mean(name):
    found = format_named(name).pairs({f: text.encode() for f, text in FOREIGN[name].items()}, FrameNames())
    np.testing.assert_allclose(found["camera_lidar"], T_CAMERA_LIDAR, atol=1e-12)
    np.testing.assert_allclose(found["lidar_radar"], T_LIDAR_RADAR, atol=1e-12)


def test_every_format_stands_in_these_tests():
    assert EXPECTED.keys() | {"tf-static", "vod"} == FORMATS.keys()
    assert (
        FOREIGN.keys() | {"t4", "tf-static", "xacro"} == FORMATS.keys()
    )  # these three are read by another's reader


def test_kitti_s_images_are_of_a_camera_beside_the_one_that_its_transform_is_to():
    """P2's last column is -800 * 0.06, so image_2's camera lies 6 cm to the right of the reference."""
    text = (
        "P2: 800 0 640 -48 0 800 360 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
        "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0.5 1 0 0 -1\n"
    )
    found = format_named("kitti").pairs({"calib.txt": text.encode()}, FrameNames())
    wanted = T_CAMERA_LIDAR + np.array([[0, 0, 0, -0.06], *[[0] * 4] * 3])
    np.testing.assert_allclose(found["camera_lidar"], wanted, atol=1e-12)

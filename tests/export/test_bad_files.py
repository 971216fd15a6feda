"""Files that cannot be right end in one error that names the file and the field."""

import pytest

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import FrameNames
from pipeline.export.formats import FORMATS, format_named

LAUNCH = "launch:\n- node: {exec: static_transform_publisher, args: "
BAD = [
    ("ros2", {"a.launch.py": "Node(executable='static_transform_publisher', arguments=['--x', '1'])"},
     r"a\.launch\.py: --y"),
    ("ros2", {"a.launch.py": "def ("}, r"a\.launch\.py: is not Python"),
    ("ros2", {"a.launch.yaml": LAUNCH + "--x one}"}, "--x: 'one' is not a number"),
    ("ros2", {"a.launch.yaml": "nodes: []"}, r"a\.launch\.yaml: launch: missing"),
    ("tf-static", {"a.mcap": "no mcap"}, r"a\.mcap: /tf_static"),
    ("urdf", {"a.urdf": "<robot>"}, r"a\.urdf: not readable XML"),
    ("urdf", {"a.urdf": '<robot><joint name="j" type="fixed"><origin xyz="0 0"/><parent link="lidar"/>'
              '<child link="camera"/></joint></robot>'}, "joint 'j': xyz"),
    ("urdf", {"a.urdf": '<robot><joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint></robot>'},
     r"the file has: a, b\. Name them with --camera-frame"),
    ("xacro", {"a.xacro": '<robot><joint name="j" type="fixed"><origin xyz="${x} 0 0"/><parent link="lidar"/>'
               '<child link="camera"/></joint></robot>'}, "expand xacro"),
    ("autoware", {"k.yaml": "kit:\n  camera: {x: 0, y: 0, z: 0, roll: 0, pitch: 0}\n"},
     r"k\.yaml: kit\.camera\.yaw: missing"),
    ("autoware", {"k.yaml": "- 1"}, r"k\.yaml: is not a map"),
    ("autoware", {"k.yaml": "kit:\n  camera: {x: .nan, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}\n"},
     r"kit\.camera\.x: nan is not finite"),
    ("kitti", {"c.txt": "Tr_velo_to_cam: 1 0 0\n"}, r"c\.txt: Tr_velo_to_cam: needs 12 or 16"),
    ("kitti", {"c.txt": "Tr_velo_to_cam: 2 0 0 0 0 1 0 0 0 0 1 0\n"}, "Tr_velo_to_cam: its 3x3 part is not a rotation"),
    ("kitti", {"c.txt": "Tr_velo_to_cam: 1 0 0 0 0 1 0 0 0 0 x 0\n"}, "Tr_velo_to_cam: is not a number"),
    ("kitti", {"c.txt": "P2: 1 0 0 0 0 1 0 0 0 0 1 0\n"}, "Tr_velo_to_cam: missing"),
    ("kitti", {"c.txt": "Tr_velo_to_cam: 1 0 0 0 0 1 0 0 0 0 1 0\nP2: 1 2\n"}, r"c\.txt: P2: is not a 3x4"),
    ("vod", {"c.txt": ""}, "give two files"),
    ("nuscenes", {"sensor.json": "[]"}, r"calibrated_sensor\.json: missing"),
    ("nuscenes", {"sensor.json": "[]", "calibrated_sensor.json": '[{"sensor_token": "x"}]'}, r"0\.sensor_token"),
    ("t4", {"sensor.json": '[{"token": "a", "channel": "camera"}]', "calibrated_sensor.json":
            '[{"sensor_token": "a", "rotation": [1, 0, 0], "translation": [0, 0, 0]}]'}, r"0\.rotation\.3: missing"),
    ("kalibr", {"k.yaml": "cam0: {camera_model: pinhole}"}, r"k\.yaml: cam0\.T_cam_lidar: missing"),
    ("kalibr", {"k.yaml": "cam0: ["}, r"k\.yaml: not readable YAML"),
    ("opencv", {"o.yaml": "%YAML:1.0\n---\nx: 1\n"}, r"o\.yaml: T_camera_lidar: missing"),
    ("opencv", {"o.yaml": "not a storage"}, r"o\.yaml"),
    ("t4", {"sensor.json": '[{"token": "a", "channel": "camera"}]', "calibrated_sensor.json":
            '[{"sensor_token": "a", "rotation": [0.5, 0, 0, 0], "translation": [0, 0, 0]}]'}, "has length 0.5"),
    ("t4", {"sensor.json": "{"}, r"sensor\.json: not readable JSON"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "files", "words"), BAD)
def test_a_bad_file_is_named_with_its_field(name, files, words):
    with pytest.raises(ConfigError, match=words) as caught:
        format_named(name).pairs({file: text.encode() for file, text in files.items()}, FrameNames())
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"null", b"[]", b"{}", b"0", b"a: b", b"<a/>"])
def test_nonsense_is_refused_by_every_format_in_words(name, content):
    files = (
        {"sensor.json": content, "calibrated_sensor.json": content}
        if name in ("nuscenes", "t4")
        else {"f": content}
    )
    with pytest.raises(ConfigError):
        format_named(name).pairs(files, FrameNames())

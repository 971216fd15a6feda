"""Opens exported files with the programs they are for; runs under a Python that has these, apart from the project's.

python tests/export/real_readers.py FOLDER    prints JSON: format -> reader and version, and the transforms it found

`make readers` installs them, and `make test` names their Python in BORESIGHT_READERS.
"""

import json
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np

NUSCENES_TABLES = (
    *("category", "attribute", "visibility", "instance", "ego_pose", "log", "scene", "sample", "sample_data"),
    *("sample_annotation", "map"),
)


def urdf(folder):
    from yourdfpy import URDF

    return "yourdfpy", _of_robot(URDF.load(str(folder / "sensors.urdf"), load_meshes=False))


def xacro(folder):
    return "xacro", _of_robot(_expanded(folder / "sensors.urdf.xacro"))


def autoware(folder):
    car = folder / "car.xacro"
    car.write_text(f"""<robot name="car" xmlns:xacro="http://ros.org/wiki/xacro">
<xacro:include filename="{folder}/sensor_kit.xacro"/><link name="base_link"/>
<xacro:sensor_kit_macro parent="base_link" x="0.9" y="0" z="2" roll="0" pitch="0.01" yaw="0" config_dir="{folder}"/>
</robot>""")
    found = _of_robot(_expanded(car))
    # The optical frame below the camera's link, as Autoware's camera xacros hang it (REP 103): -pi/2, 0, -pi/2.
    T_link_optical = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    found["camera_lidar"] = np.linalg.inv(T_link_optical) @ found["camera_lidar"]
    return "xacro", found


def _expanded(path):
    import xacro
    from yourdfpy import URDF

    expanded = path.with_suffix(".expanded.urdf")
    expanded.write_text(xacro.process_file(str(path)).toxml())
    return URDF.load(str(expanded), load_meshes=False)


def _of_robot(robot):
    return {
        "camera_lidar": robot.get_transform(frame_to="lidar", frame_from="camera"),
        "lidar_radar": robot.get_transform(frame_to="radar", frame_from="lidar"),
    }


def nuscenes(folder):
    import cv2
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.geometry_utils import transform_matrix
    from pyquaternion import Quaternion

    for table in NUSCENES_TABLES:
        (folder / f"{table}.json").write_text("[]")
    cv2.imwrite(str(folder.parent / "map.png"), np.zeros((4, 4), np.uint8))  # the devkit wants one map
    one_map = {"token": "m", "log_tokens": [], "category": "semantic_prior", "filename": "map.png"}
    (folder / "map.json").write_text(json.dumps([one_map]))
    data = NuScenes(folder.name, str(folder.parent), verbose=False)
    T_ego = {}
    for row in data.calibrated_sensor:
        channel = data.get("sensor", row["sensor_token"])["channel"]
        T_ego[channel] = transform_matrix(row["translation"], Quaternion(row["rotation"]))
        if channel == "camera":
            assert np.array(row["camera_intrinsic"]).shape == (3, 3)
    return "nuscenes-devkit", _of_ego(T_ego)


def t4(folder):
    from t4_devkit.schema import CalibratedSensor, Sensor

    sensors = {s.token: s for s in Sensor.from_json(str(folder / "sensor.json"))}
    T_ego = {}
    for row in CalibratedSensor.from_json(str(folder / "calibrated_sensor.json")):
        T = row.rotation.transformation_matrix
        T[:3, 3] = row.translation
        T_ego[sensors[row.sensor_token].channel] = T
    return "t4-devkit", _of_ego(T_ego)


def _of_ego(T_ego):
    return {
        "camera_lidar": np.linalg.inv(T_ego["camera"]) @ T_ego["lidar"],
        "lidar_radar": np.linalg.inv(T_ego["lidar"]) @ T_ego["radar"],
    }


def kitti(folder):
    from pykitti.utils import read_calib_file

    lines = read_calib_file(str(folder / "calib.txt"))
    last = [[0, 0, 0, 1]]
    return "pykitti", {
        "camera_lidar": np.vstack([lines["Tr_velo_to_cam"].reshape(3, 4), last]),
        "lidar_radar": np.vstack([lines["Tr_radar_to_velo"].reshape(3, 4), last]),
    }


def opencv(folder):
    import cv2

    storage = cv2.FileStorage(str(folder / "calibration.yaml"), cv2.FILE_STORAGE_READ)
    return "opencv-python-headless", {
        pair: storage.getNode(f"T_{pair}").mat() for pair in ("camera_lidar", "lidar_radar")
    }


READERS = {f.__name__: f for f in (urdf, xacro, autoware, nuscenes, t4, kitti, opencv)}


def main():
    found = {}
    for name, read in READERS.items():
        reader, transforms = read(Path(sys.argv[1]) / name)
        found[name] = {
            "reader": f"{reader} {version(reader)}",
            **{k: np.asarray(T).tolist() for k, T in transforms.items()},
        }
    print(json.dumps(found))


if __name__ == "__main__":
    main()

"""Opens folders of data sets with the devkits that they come with; runs under a Python that has these.

python tests/convert/real_devkits.py NUSCENES_FOLDER VOD_FOLDER    prints JSON: what they find in the first frame

The Python is that of tests/export/real_readers.py.
"""

import json
import sys
from importlib.metadata import version
from types import ModuleType

import numpy as np


def nuscenes(folder):
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.data_classes import LidarPointCloud, RadarPointCloud
    from nuscenes.utils.geometry_utils import transform_matrix
    from pyquaternion import Quaternion

    data = NuScenes("v1.0-mini", folder, verbose=False)
    T_ego, path = {}, {}
    for row in data.sample_data:
        sensor = data.get("calibrated_sensor", row["calibrated_sensor_token"])
        T_ego[row["channel"]] = transform_matrix(sensor["translation"], Quaternion(sensor["rotation"]))
        path.setdefault(row["channel"], data.get_sample_data_path(row["token"]))
    lidar = LidarPointCloud.from_file(path["LIDAR_TOP"]).points
    # In the ego frame, where no choice of the lidar's own axes counts.
    homogeneous = np.vstack([lidar[:3], np.ones(lidar.shape[1])])
    radar = RadarPointCloud.from_file(path["RADAR_FRONT"]).points
    return {
        "devkit": f"nuscenes-devkit {version('nuscenes-devkit')}",
        "lidar_base": (T_ego["LIDAR_TOP"] @ homogeneous)[:3].T.tolist(),
        "radar": radar[:3].T.tolist(),
        "camera_radar": (np.linalg.inv(T_ego["CAM_FRONT"]) @ T_ego["RADAR_FRONT"]).tolist(),
    }


def view_of_delft(folder):
    sys.modules["k3d"] = ModuleType("k3d")  # pictures in notebooks, which nobody looks at here
    sys.modules["k3d.plot"] = ModuleType("k3d.plot")
    sys.modules["k3d.plot"].Plot = object
    from vod.configuration import KittiLocations
    from vod.frame import FrameDataLoader, FrameTransformMatrix

    frame = FrameDataLoader(KittiLocations(root_dir=folder, output_dir=folder), "00003")
    transforms = FrameTransformMatrix(frame)
    return {
        "devkit": f"vod-tudelft {version('vod-tudelft')}",
        "lidar": frame.lidar_data[:, :3].tolist(),
        "radar": frame.radar_data[:, :3].tolist(),
        "range_rate": frame.radar_data[:, 4].tolist(),
        "lidar_radar": transforms.t_lidar_radar.tolist(),
        "odom_lidar": (transforms.t_odom_camera @ transforms.t_camera_lidar).tolist(),
    }


if __name__ == "__main__":
    print(json.dumps({"nuscenes": nuscenes(sys.argv[1]), "vod": view_of_delft(sys.argv[2])}))

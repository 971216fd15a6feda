"""Opens exported frames with nuScenes' devkit; runs under a Python that has it.

python tests/learn/frames/real_loaders.py FOLDER    prints JSON: what it finds

The Python is that of tests/export/real_readers.py.
"""

import json
import sys


def nuscenes(folder):
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.data_classes import LidarPointCloud, RadarPointCloud
    from nuscenes.utils.splits import get_scenes_of_custom_split

    data = NuScenes("v1.0-boresight", folder, verbose=False)
    sample = data.get("sample", data.scene[0]["first_sample_token"])["data"]
    points, _, _ = data.explorer.map_pointcloud_to_image(sample["LIDAR_TOP"], sample["CAM_FRONT"])
    return {
        "samples": len(data.sample),
        "scenes": {s: len(get_scenes_of_custom_split(s, data)) for s in ("train", "val", "test")},
        "lidar": LidarPointCloud.from_file(data.get_sample_data_path(sample["LIDAR_TOP"])).nbr_points(),
        "radar": RadarPointCloud.from_file(data.get_sample_data_path(sample["RADAR_FRONT"])).nbr_points(),
        "in_image": points.shape[1],
    }


if __name__ == "__main__":
    print(json.dumps(nuscenes(sys.argv[1])))

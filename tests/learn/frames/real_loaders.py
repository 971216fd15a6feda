"""Opens exported frames with the devkit and the loader that they are for; runs under a Python that has these.

python tests/learn/frames/real_loaders.py NUSCENES_FOLDER WEBDATASET_FOLDER    prints JSON: what they find

The Python is that of tests/export/real_readers.py.
"""

import json
import sys
from pathlib import Path


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


def webdataset(folder):
    from webdataset import WebDataset

    shards = sorted(map(str, Path(folder).glob("train/*.tar")))
    samples = list(WebDataset(shards, shardshuffle=False).decode("rgb8"))
    return {s["__key__"]: [*s["lidar.npy"].shape, *s["camera.jpg"].shape] for s in samples}


if __name__ == "__main__":
    print(json.dumps({"nuscenes": nuscenes(sys.argv[1]), "webdataset": webdataset(sys.argv[2])}))

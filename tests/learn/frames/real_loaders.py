"""Opens exported frames with the devkit and the loader that they are for; runs under a Python that has these.

python tests/learn/frames/real_loaders.py NUSCENES_FOLDER WEBDATASET_FOLDER KITTI_FOLDER    prints JSON: what they find

The Python is that of tests/export/real_readers.py.
"""

import json
import sys
from pathlib import Path

import numpy as np


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


def kitti(folder):
    from pykitti.utils import load_image, load_velo_scan, read_calib_file

    training, found = Path(folder, "training"), {}
    for path in sorted((training / "velodyne").glob("*.bin")):
        image = load_image(training / "image_2" / f"{path.stem}.png", "RGB")
        points, calib = load_velo_scan(path), read_calib_file(training / "calib" / f"{path.stem}.txt")
        P2, T_camera_lidar = calib["P2"].reshape(3, 4), calib["Tr_velo_to_cam"].reshape(3, 4)
        rectified = (
            calib["R0_rect"].reshape(3, 3)
            @ T_camera_lidar
            @ np.vstack([points[:, :3].T, np.ones(len(points))])
        )
        u, v, depth = P2 @ np.vstack([rectified, np.ones(len(points))])
        seen = (depth > 0.5) & (abs(u / depth - image.width / 2) < image.width / 2)
        seen &= abs(v / depth - image.height / 2) < image.height / 2
        about = {
            "size": image.size,
            "points": len(points),
            "first": points[0].tolist(),
            "in_image": int(seen.sum()),
        }
        found[path.stem] = about | {"T_camera_lidar": T_camera_lidar.tolist()}
    return found


if __name__ == "__main__":
    readers = (nuscenes, webdataset, kitti)
    print(
        json.dumps({read.__name__: read(folder) for read, folder in zip(readers, sys.argv[1:], strict=True)})
    )

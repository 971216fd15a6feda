"""Small folders of exactly the shape of public data sets: a car that drives 10 m/s straight on past what stands still.

Base, camera, lidar and radar are where a car has them; the lidar stands 1.8 m up, the camera 0.3 m ahead of and below
it, the radar 2 m ahead of it. A wall of posts stands along the road.
"""

import json

import cv2
import numpy as np

SPEED_MPS = 10.0
BASELINE_M = 0.54
WIDTH, HEIGHT = 160, 96
K = np.array([[120.0, 0, 80], [0, 120.0, 48], [0, 0, 1]])
R_BODY_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def pose(t, R=None):
    T = np.eye(4)
    T[:3, 3] = t
    if R is not None:
        T[:3, :3] = R
    return T


T_BASE_LIDAR = pose([1.0, 0, 1.8])
T_BASE_CAMERA = pose([1.3, 0, 1.5], R_BODY_OPTICAL)
T_BASE_RADAR = pose([3.0, 0, 0.6])


def image_bytes(extension, n=0):
    """Of frame n: no two pictures of a camera are the same."""
    pixels = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    pixels[60:] = 40
    pixels[:16, :16] = 2 * n
    return cv2.imencode(extension, pixels)[1].tobytes()


def posts(x_base):
    """Points of posts 8 m to either side and of the road, in the axes of the base that stands at x_base."""
    along = np.arange(0.0, 120, 4)
    z = np.linspace(0.2, 3, 12)
    rows = [(x, y, h) for x in along for y in (-8.0, 8.0) for h in z]
    road = [(x, y, 0.0) for x in np.arange(3.0, 40, 0.7) for y in np.arange(-5.0, 5.1, 0.7)]
    points = np.array(rows) - [x_base % 4, 0, 0]
    return np.vstack([points, road])


def lidar_points(x_base):
    shift = [0, 1e-4 * x_base, 1e-4 * x_base]  # no two sweeps are the same
    points = posts(x_base) - T_BASE_LIDAR[:3, 3] + shift
    return np.hstack([points, np.full((len(points), 1), 20.0)]).astype(np.float32)


def radar_points(x_base):
    """x, y, z, rcs and the range rate of what stands still."""
    points = posts(x_base)[:720:12] - T_BASE_RADAR[:3, 3] + [0, 1e-4 * x_base, 1e-4 * x_base]
    points = points[points[:, 0] > 2]
    rate = -SPEED_MPS * points[:, 0] / np.linalg.norm(points, axis=1)
    return np.column_stack([points, np.full(len(points), 5.0), rate])


def view_of_delft(folder, frames=12, jump_at=None):
    """lidar/ and radar/ with training/{image_2, velodyne, calib, pose}."""
    lidar, radar = folder / "lidar" / "training", folder / "radar" / "training"
    for path in ("image_2", "velodyne", "calib", "pose"):
        (lidar / path).mkdir(parents=True)
        (radar / path).mkdir(parents=True)
    inverse = np.linalg.inv
    T_camera_lidar, T_camera_radar = (inverse(T_BASE_CAMERA) @ T for T in (T_BASE_LIDAR, T_BASE_RADAR))
    P2 = " ".join(map(str, np.hstack([K, np.zeros((3, 1))]).ravel()))
    for n in range(frames):
        name = f"{n:05d}"
        (lidar / "image_2" / f"{name}.jpg").write_bytes(image_bytes(".jpg", n))
        x = SPEED_MPS * 0.1 * n + (500 if jump_at is not None and n >= jump_at else 0)
        (lidar / "velodyne" / f"{name}.bin").write_bytes(lidar_points(x).tobytes())
        points = radar_points(x)
        rows = np.column_stack([points, points[:, 4] * 0, points[:, 4] * 0]).astype(np.float32)
        (radar / "velodyne" / f"{name}.bin").write_bytes(rows.tobytes())
        for root, T in ((lidar, T_camera_lidar), (radar, T_camera_radar)):
            lines = [f"P0: {P2}", f"P1: {P2}", f"P2: {P2}", f"P3: {P2}", "R0_rect: 1 0 0 0 1 0 0 0 1"]
            lines += [f"Tr_velo_to_cam: {' '.join(map(str, T[:3].ravel()))}", f"Tr_imu_to_velo: {P2}"]
            (root / "calib" / f"{name}.txt").write_text("\n".join(lines))
        T_odom_camera = pose([x, 0, 0]) @ T_BASE_CAMERA
        keys = ("odomToCamera", "mapToCamera", "UTMToCamera")
        lines = [json.dumps({key: T_odom_camera.ravel().tolist()}) for key in keys]
        (lidar / "pose" / f"{name}.json").write_text("\n".join(lines))
    return folder


def kitti(folder, frames=6, *, second_camera=False):
    """image_2, velodyne, radar and calib of one folder; the camera of P2 lies 6 cm beside the reference camera.

    That of P3 lies a baseline to the right of it, where it is wanted.
    """
    for path in ("image_2", *(["image_3"] if second_camera else []), "velodyne", "radar", "calib"):
        (folder / path).mkdir(parents=True)
    P = np.hstack([K, np.array([[-120.0 * 0.06], [0], [0]])])
    P3 = np.hstack([K, np.array([[-120.0 * (0.06 + BASELINE_M)], [0], [0]])])
    T_ref_lidar = pose([0.06, 0, 0]) @ np.linalg.inv(T_BASE_CAMERA) @ T_BASE_LIDAR
    T_lidar_radar = np.linalg.inv(T_BASE_LIDAR) @ T_BASE_RADAR
    for n in range(frames):
        name = f"{n:06d}"
        (folder / "image_2" / f"{name}.png").write_bytes(image_bytes(".png", n))
        if second_camera:
            (folder / "image_3" / f"{name}.png").write_bytes(image_bytes(".png", n + frames))
        (folder / "velodyne" / f"{name}.bin").write_bytes(lidar_points(n).tobytes())
        (folder / "radar" / f"{name}.bin").write_bytes(radar_points(n).astype(np.float32).tobytes())
        lines = {
            "P2": P, "P3": P3, "R0_rect": np.eye(3), "Tr_velo_to_cam": T_ref_lidar[:3],
            "Tr_radar_to_velo": T_lidar_radar[:3],
        }  # fmt: skip
        text = [f"{key}: {' '.join(map(str, M.ravel()))}" for key, M in lines.items()]
        (folder / "calib" / f"{name}.txt").write_text("\n".join(text) + "\n\n")
    return folder


def nuscenes(folder, frames=12):
    """v1.0-mini of one scene, with samples and sweeps: every fourth frame is a sample, the others are sweeps."""
    half = np.sqrt(0.5)
    sensors = {
        # Rotation (w x y z) and translation of each in the base; nuScenes' lidar is turned by -90 deg: y forward.
        "CAM_FRONT": ("camera", [0.5, -0.5, 0.5, -0.5], T_BASE_CAMERA[:3, 3]),
        "LIDAR_TOP": ("lidar", [half, 0, 0, -half], T_BASE_LIDAR[:3, 3]),
        "RADAR_FRONT": ("radar", [1, 0, 0, 0], T_BASE_RADAR[:3, 3]),
        "CAM_BACK": ("camera", [0.5, -0.5, -0.5, 0.5], [-1, 0, 1.5]),
    }
    tables = {
        name: [] for name in ("category", "attribute", "visibility", "instance", "sample_annotation", "map")
    }
    tables |= {name: [] for name in ("sensor", "calibrated_sensor", "ego_pose", "sample", "sample_data")}
    tables["log"] = [
        {"token": "log", "logfile": "l", "vehicle": "n008", "date_captured": "2018-08-01", "location": "x"}
    ]
    tables["scene"] = [{"token": "scene", "log_token": "log", "name": "scene-0001", "nbr_samples": 3}]
    for channel, (modality, q, t) in sensors.items():
        tables["sensor"].append({"token": f"s-{channel}", "channel": channel, "modality": modality})
        tables["calibrated_sensor"].append({
            "token": f"c-{channel}", "sensor_token": f"s-{channel}", "rotation": list(q), "translation": list(t),
            "camera_intrinsic": K.tolist() if modality == "camera" else [],
        })  # fmt: skip
    for n in range(frames):
        stamp_us = 1_533_151_603_000_000 + n * 50_000
        x = SPEED_MPS * 0.05 * n
        if n % 4 == 0:
            tables["sample"].append({"token": f"sample-{n}", "scene_token": "scene", "timestamp": stamp_us})
        folder_name = "samples" if n % 4 == 0 else "sweeps"
        points = lidar_points(x)
        own = np.column_stack([-points[:, 1], points[:, 0], points[:, 2:4], np.arange(len(points)) % 32])
        contents = {
            "CAM_FRONT": (".jpg", image_bytes(".jpg", n)),
            "LIDAR_TOP": (".pcd.bin", own.astype(np.float32).tobytes()),
            "RADAR_FRONT": (".pcd", pcd(radar_points(x))),
            "CAM_BACK": (".jpg", image_bytes(".jpg")),
        }
        for k, (channel, (suffix, data)) in enumerate(contents.items()):
            path = folder / folder_name / channel / f"{n}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            token = f"{channel}-{n}"
            tables["ego_pose"].append({"token": token, "timestamp": stamp_us, "rotation": [1, 0, 0, 0],
                                       "translation": [x + 400, 1000, 0]})  # fmt: skip
            tables["sample_data"].append({
                "token": token, "sample_token": f"sample-{n - n % 4}", "ego_pose_token": token,
                "calibrated_sensor_token": f"c-{channel}", "timestamp": stamp_us + k * 1000,
                "filename": str(path.relative_to(folder)), "is_key_frame": n % 4 == 0, "fileformat": "jpg",
                "width": WIDTH if "CAM" in channel else 0, "height": HEIGHT if "CAM" in channel else 0,
            })  # fmt: skip
    tables["map"] = [
        {"token": "map", "log_tokens": ["log"], "category": "semantic_prior", "filename": "maps/m.png"}
    ]
    (folder / "maps").mkdir()
    (folder / "maps" / "m.png").write_bytes(image_bytes(".png"))
    (folder / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (folder / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return folder


def pcd(points):
    """A radar scan of nuScenes: eighteen fields, velocity as a vector along the ray, one ambiguous point at the end."""
    fields = (
        "x y z dyn_prop id rcs vx vy vx_comp vy_comp is_quality_valid ambig_state x_rms y_rms invalid_state pdh0 "
        "vx_rms vy_rms"
    )
    sizes = "4 4 4 1 2 4 4 4 4 4 1 1 1 1 1 1 1 1"
    types = "F F F I I F F F F F I I I I I I I I"
    names = fields.split()
    dtype = np.dtype(
        [(n, f"<{t.lower()}{s}") for n, t, s in zip(names, types.split(), sizes.split(), strict=True)]
    )
    rows = np.zeros(len(points) + 1, dtype)
    flat = np.hypot(points[:, 0], points[:, 1])
    rate = -SPEED_MPS * points[:, 0] / flat  # this radar sees no height
    rows["x"][:-1], rows["y"][:-1], rows["rcs"][:-1] = points[:, 0], points[:, 1], 5
    rows["vx"][:-1], rows["vy"][:-1] = rate * points[:, 0] / flat, rate * points[:, 1] / flat
    rows["ambig_state"], rows["x"][-1] = 3, 7.0
    rows["ambig_state"][-1] = 1
    header = f"""# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS {fields}
SIZE {sizes}
TYPE {types}
COUNT {" ".join(["1"] * len(names))}
WIDTH {len(rows)}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {len(rows)}
DATA binary
"""
    return header.encode() + rows.tobytes() + b"\n"  # the devkit asks for a byte behind the last point

"""A street of KITTI in KITTI's own layout, converted by the command, from a log of its frames."""

import json

import numpy as np
from mcap.reader import make_reader

from jobs.cli import main
from pipeline.core.ros_messages import RosMessages
from pipeline.rig.topics import TOPICS
from tests.makers.real_models import write_real_manifests


def given_of(log):
    """T_camera_lidar that came with the log."""
    given = json.loads((log.parent / "given_calibration.json").read_text())
    return np.array(given[log.stem]["T_camera_lidar"])


def converted_street(log, out, day, models):
    """Logs and fleet.toml in `out`; `models` are the files of a segmenter and a detector."""
    kitti_folder(log, given_of(log), out / "data")
    write_real_manifests(out, *models)
    call = [
        "convert", "kitti", str(out / "data"), "--out", str(out), "--vehicle", day.vehicle, "--day", day.day,
    ]  # fmt: skip
    if main([*call, "--segmenter", "segmenter.toml", "--detector", "detector.toml"]):
        raise RuntimeError(f"{log} was not converted")


def kitti_folder(log, given, folder):
    """The frames of a log as KITTI's object kit lays them out, named by their number at 10 Hz."""
    store, first = RosMessages(2).typestore, None
    for path in ("image_2", "velodyne", "calib"):
        (folder / path).mkdir(parents=True)
    with log.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages(topics=list(TOPICS.values())):
            first = first or message.log_time
            name = f"{round((message.log_time - first) / 1e8):06d}"
            held = store.deserialize_cdr(message.data, schema.name)
            if channel.topic == TOPICS["image"]:
                (folder / "image_2" / f"{name}.jpg").write_bytes(bytes(held.data))
            elif channel.topic == TOPICS["lidar"]:
                rows = np.frombuffer(held.data.tobytes(), "<f4").reshape(-1, held.point_step // 4)
                (folder / "velodyne" / f"{name}.bin").write_bytes(rows[:, :4].tobytes())
            elif channel.topic == TOPICS["info"]:
                P = np.hstack([np.reshape(held.k, (3, 3)), np.zeros((3, 1))])
                lines = {"P2": P, "R0_rect": np.eye(3), "Tr_velo_to_cam": given[:3]}
                text = [f"{key}: {' '.join(map(repr, M.ravel().tolist()))}" for key, M in lines.items()]
                (folder / "calib" / f"{name}.txt").write_text("\n".join(text))

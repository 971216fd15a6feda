"""Topics and frames of logs written by Boresight: simulated logs and converted data sets."""

from __future__ import annotations

from typing import Final

from pipeline.rig.graph import Kind

__all__ = ["TOPICS", "frame_of", "topics_of"]

# For sensors named camera, lidar and radar, and for the vehicle.
TOPICS: Final = {
    "tf": "/tf_static",
    "info": "/camera/front/camera_info",
    "image": "/camera/front/image/compressed",
    "lidar": "/lidar/top/points",
    "radar": "/radar/front/points",
    "labels": "/perception/camera/labels",
    "detections": "/perception/camera/detections",
    "odometry": "/vehicle/odometry",
}
_FRAMES: Final = {
    "camera": "camera_front_optical",
    "lidar": "lidar_top",
    "radar": "radar_front",
    "base": "base_link",
}


def topics_of(name: str, kind: Kind) -> dict[str, str]:
    """Topics of a sensor: image, info, labels, detections of a camera; else points."""
    if kind != "camera":
        points = TOPICS[kind] if name == kind else f"/{kind}/{name}/points"
        return {"points": points}
    if name == kind:
        return {n: TOPICS[n] for n in ("info", "image", "labels", "detections")}
    return {
        "info": f"/camera/{name}/camera_info",
        "image": f"/camera/{name}/image/compressed",
        "labels": f"/perception/{name}/labels",
        "detections": f"/perception/{name}/detections",
    }


def frame_of(node: str) -> str:
    """Frame id of a sensor or of the base: the sensor's name, except for camera, lidar and radar."""
    return _FRAMES.get(node, node)

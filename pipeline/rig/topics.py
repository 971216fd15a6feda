"""Topics and frames of the logs that are written here: simulated ones, and those of converted data sets."""

from __future__ import annotations

from typing import Final

from pipeline.rig.graph import Kind

__all__ = ["TOPICS", "frame_of", "topics_of"]

# Of a rig whose sensors are called camera, lidar and radar, and of the vehicle.
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
    """Topics of a sensor: image, info, labels and detections of a camera, points of another, a radar's alignment."""
    if kind != "camera":
        points = TOPICS[kind] if name == kind else f"/{kind}/{name}/points"
        alignment = points.replace("points", "location_attributes")
        return {"points": points} | ({"alignment": alignment} if kind == "radar" else {})
    if name == kind:
        return {n: TOPICS[n] for n in ("info", "image", "labels", "detections")}
    return {
        "info": f"/camera/{name}/camera_info",
        "image": f"/camera/{name}/image/compressed",
        "labels": f"/perception/{name}/labels",
        "detections": f"/perception/{name}/detections",
    }


def frame_of(node: str) -> str:
    """The frame of a sensor, which has its name but for camera, lidar and radar, or of the base."""
    return _FRAMES.get(node, node)

"""Topics of a simulated log."""

from __future__ import annotations

from typing import Final

from pipeline.rig.graph import Kind

__all__ = ["TOPICS", "topics_of"]

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


def topics_of(name: str, kind: Kind) -> dict[str, str]:
    """Topics of a sensor: image, info, labels and detections of a camera, points of another."""
    if name == kind:
        cameras = ("info", "image", "labels", "detections")
        return {n: TOPICS[n] for n in cameras} if kind == "camera" else {"points": TOPICS[kind]}
    if kind != "camera":
        return {"points": f"/{kind}/{name}/points"}
    return {
        "info": f"/camera/{name}/camera_info",
        "image": f"/camera/{name}/image/compressed",
        "labels": f"/perception/{name}/labels",
        "detections": f"/perception/{name}/detections",
    }

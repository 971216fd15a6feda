"""Message definitions for bags that contain none (ROS 2 Humble and older) and that rosbags does not bundle.

When reading a log, they are used only if the log itself has no definition; a message that does not fit byte
for byte is refused. Logs that are written here use the same definitions. Source: vision_msgs 4.1 (Humble);
radar_msgs 0.2 (Humble).
"""

from __future__ import annotations

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

__all__ = ["DEFINITIONS", "register"]

# type -> (types that it needs, text)
DEFINITIONS: dict[str, tuple[tuple[str, ...], str]] = {
    "vision_msgs/msg/Point2D": ((), "float64 x\nfloat64 y\n"),
    "vision_msgs/msg/Pose2D": ((), "vision_msgs/Point2D position\nfloat64 theta\n"),
    "vision_msgs/msg/BoundingBox2D": ((), "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"),
    "vision_msgs/msg/ObjectHypothesis": ((), "string class_id\nfloat64 score\n"),
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        (),
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    ),
    "vision_msgs/msg/Detection2D": (
        (),
        (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
            "vision_msgs/BoundingBox2D bbox\nstring id\n"
        ),
    ),
    "vision_msgs/msg/Detection2DArray": (
        (
            "vision_msgs/msg/Point2D",
            "vision_msgs/msg/Pose2D",
            "vision_msgs/msg/BoundingBox2D",
            "vision_msgs/msg/ObjectHypothesis",
            "vision_msgs/msg/ObjectHypothesisWithPose",
            "vision_msgs/msg/Detection2D",
        ),
        "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n",
    ),
    "radar_msgs/msg/RadarReturn": (
        (),
        "float32 range\nfloat32 azimuth\nfloat32 elevation\nfloat32 doppler_velocity\nfloat32 amplitude\n",
    ),
    "radar_msgs/msg/RadarScan": (
        ("radar_msgs/msg/RadarReturn",),
        "std_msgs/Header header\nradar_msgs/RadarReturn[] returns\n",
    ),
    "radar_msgs/msg/RadarTrack": (
        (),
        (
            "unique_identifier_msgs/UUID uuid\n"
            "geometry_msgs/Point position\ngeometry_msgs/Vector3 velocity\n"
            "geometry_msgs/Vector3 acceleration\ngeometry_msgs/Vector3 size\nuint16 classification\n"
            "float32[6] position_covariance\nfloat32[6] velocity_covariance\n"
            "float32[6] acceleration_covariance\n"
            "float32[6] size_covariance\n"
        ),
    ),
    "radar_msgs/msg/RadarTracks": (
        ("radar_msgs/msg/RadarTrack",),
        "std_msgs/Header header\nradar_msgs/RadarTrack[] tracks\n",
    ),
}


def register(store: Typestore, msgtype: str) -> None:
    """Add one type of DEFINITIONS and the types it needs."""
    for name in (*DEFINITIONS[msgtype][0], msgtype):
        store.register(get_types_from_msg(DEFINITIONS[name][1], name))

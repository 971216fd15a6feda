"""Message definitions for bags that contain none (ROS 2 Humble and older) and that rosbags does not bundle.

When reading a log, they are used only if the log itself has no definition; a message that does not fit byte
for byte is refused. Logs that are written here use the same definitions. Source: vision_msgs 4.1 (Humble);
radar_msgs 0.2 (Humble); off_highway_premium_radar_msgs 0.9.
"""

from __future__ import annotations

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

__all__ = ["DEFINITIONS", "register"]

_BOSCH = "off_highway_premium_radar_msgs"
_PARTS = (
    "Time", "OperationMode", "LocationAttributesHeader", "SensorModulationPerformance", "MisalignmentPacket",
    "InterferenceIndicator", "SensorFieldOfView", "LocationAttributesPacket",
)  # fmt: skip
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
    f"{_BOSCH}/msg/Time": ((), "uint32 sec\nuint32 nanosec\n"),
    f"{_BOSCH}/msg/OperationMode": ((), "uint8 operation_mode\n"),
    f"{_BOSCH}/msg/LocationAttributesHeader": (
        (),
        (
            f"uint32 lgp_version\nuint8 block_counter\n{_BOSCH}/Time start_measurement\n"
            f"{_BOSCH}/OperationMode operation_mode\nbool data_measured\n"
        ),
    ),
    f"{_BOSCH}/msg/SensorModulationPerformance": (
        (),
        (
            "uint8 detection_of_measurement_program\nuint8 modulation_id\nfloat32 distance_range_scaling\n"
            "float32 separability_distance\nfloat32 separability_relative_velocity\nfloat32 precision_distance\n"
            "float32 precision_relative_velocity\nfloat32 covariance_of_distance_and_relative_velocity\n"
            "float32 minimum_measurable_distance\nfloat32 maximum_measurable_distance\n"
            "float32 minimum_measurable_relative_velocity\nfloat32 maximum_measurable_relative_velocity\n"
        ),
    ),
    f"{_BOSCH}/msg/MisalignmentPacket": (
        (),
        (
            "float32 theta\nfloat32 theta_variance\nfloat32 phi\nfloat32 phi_variance\nfloat32 phi_eme\n"
            "float32 phi_eme_variance\nuint16 status\nuint16 status_eme\nfloat32 percent_negative_theta\n"
            "float32 min_theta_sos\nfloat32 max_theta_sos\nfloat32 theta_sos_variance\nfloat32 theta_sos_mean\n"
            "float32 min_phi_sos\nfloat32 max_phi_sos\nfloat32 phi_sos_variance\nfloat32 phi_sos_mean\n"
            "float32 phi_sos_spread\nuint16 num_sos\nuint16 num_eme\n"
        ),
    ),
    f"{_BOSCH}/msg/InterferenceIndicator": (
        (),
        "float32 fov_reduction_due_to_interfence\nuint8 interference_indicator\n",
    ),
    f"{_BOSCH}/msg/SensorFieldOfView": (
        (),
        "float32[25] fov\nfloat32[25] azimuth\nfloat32[11] elevation_range_scaling\nfloat32[11] elevation\n",
    ),
    f"{_BOSCH}/msg/LocationAttributesPacket": (
        (),
        (
            f"{_BOSCH}/SensorModulationPerformance sensor_modulation_performance\n"
            f"{_BOSCH}/MisalignmentPacket misalignment\n{_BOSCH}/InterferenceIndicator interference_indicator\n"
            f"{_BOSCH}/SensorFieldOfView sensor_field_of_view\n"
        ),
    ),
    f"{_BOSCH}/msg/LocationAttributes": (
        tuple(f"{_BOSCH}/msg/{name}" for name in _PARTS),
        (
            f"std_msgs/Header header\n{_BOSCH}/LocationAttributesHeader location_attributes_header\n"
            f"{_BOSCH}/LocationAttributesPacket location_attributes_packet\ngeometry_msgs/Pose mounting_pose\n"
        ),
    ),
}


def register(store: Typestore, msgtype: str) -> None:
    """Add one type of DEFINITIONS and the types it needs."""
    for name in (*DEFINITIONS[msgtype][0], msgtype):
        store.register(get_types_from_msg(DEFINITIONS[name][1], name))

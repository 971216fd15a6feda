"""MCAP with one tf2_msgs/TFMessage on /tf_static, as in a ROS 2 recording; provenance in its metadata.

Source: rosbag2_storage_mcap (channel metadata `offered_qos_profiles`), tf2_ros StaticTransformBroadcaster
(QoS).
"""

from __future__ import annotations

import io
import json
import struct

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType
from rosbags.typesys import Stores, get_typestore

from pipeline.core.errors import ConfigError
from pipeline.core.ros_messages import McapLog
from pipeline.export.calibration import ExportedCalibration, poses_of
from pipeline.export.formats import Files, Format
from pipeline.export.provenance import provenance_of
from pipeline.rig.transform_tree import TransformTree

__all__ = ["TF_STATIC"]

_TYPE = "tf2_msgs/msg/TFMessage"
_TOPIC = "/tf_static"
# Late subscribers receive the message too: transient local (1), reliable (1), keep last (1), as in tf2_ros.
_QOS = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: 1\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false\n"
)
# /tf_static is at the start of a log; of a larger log, give the first file of the split
_MOST_BYTES = 1 << 30


def _write(calibration: ExportedCalibration) -> dict[str, bytes]:
    stream = io.BytesIO()
    log = McapLog(stream, f"boresight {calibration.code_version}", CompressionType.NONE)
    header, edges = log.messages.header, poses_of(calibration)
    message = log.messages.transforms((header(0, edge.parent), edge.child, edge.T) for edge in edges)
    log.put(_TOPIC, 0, message, offered_qos_profiles=_QOS)
    log.writer.add_metadata("boresight", {"provenance": json.dumps(provenance_of(calibration))})
    log.writer.finish()
    return {"tf_static.mcap": stream.getvalue()}


def _tree(files: Files) -> TransformTree:
    tree, store = TransformTree(), get_typestore(Stores.ROS2_HUMBLE)
    for file, content in files.items():
        if len(content) > _MOST_BYTES:
            problem = f"is larger than {_MOST_BYTES >> 30} GiB: give a file with /tf_static alone"
            raise ConfigError(file, "", problem)
        seen = 0
        try:
            for schema, _, message in make_reader(io.BytesIO(content)).iter_messages(topics=[_TOPIC]):
                if schema is None or schema.name != _TYPE:
                    found = schema.name if schema else "no schema"
                    raise ConfigError(file, _TOPIC, f"holds {found}, not {_TYPE}")
                bad = tree.add_message(store.deserialize_cdr(message.data, _TYPE))
                if bad:
                    raise ConfigError(file, _TOPIC, f"{bad} of its entries are not rigid transforms")
                seen += 1
        except (McapError, struct.error, ValueError, IndexError, AssertionError) as err:
            raise ConfigError(file, _TOPIC, f"not a readable MCAP: {err}") from err
        if not seen:
            raise ConfigError(file, _TOPIC, "no message")
    return tree


TF_STATIC = Format("tf-static", _write, tree=_tree, holds_provenance=True)

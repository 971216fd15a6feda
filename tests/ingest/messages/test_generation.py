"""Logs that say one ROS generation and hold the other's bytes: the reason is text, and says what to do."""

import mcap.writer
import pytest
import rosbags.rosbag1.writer

from pipeline.ingest.containers.reader import Channel
from pipeline.ingest.messages.decoding import encoding_fault


def mcap_that_says(kit, said, path):
    """A drive's messages as the kit's ROS generation writes them, in channels that say `said`."""
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start(profile=said)
        for topic, kind, log_time, message in kit.messages:
            text = kit.store.generate_msgdef(kind, ros_version=kit.ros)[0]
            schema = writer.register_schema(kind, f"ros{kit.ros}msg", text.encode())
            write = kit.store.serialize_cdr if kit.ros == 2 else kit.store.serialize_ros1
            channel = writer.register_channel(topic, said, schema)
            writer.add_message(channel, log_time, bytes(write(message, kind)), log_time)
        writer.finish()
    return path


@pytest.mark.parametrize(("ros", "said", "why"), [
    (1, "cdr", "is logged as cdr (ROS 2), but its bytes are ros1 (ROS 1): convert"),
    (2, "ros1", "is logged as ros1 (ROS 1), but its bytes are cdr (ROS 2): convert"),
    (2, "cbor", "is logged as 'cbor', which is none of cdr, ros1 and protobuf: record or convert"),
])  # fmt: skip
def test_a_log_of_another_encoding_than_it_says_is_refused_in_words(
    kit, tmp_path, run_ingest, ros, said, why
):
    log = mcap_that_says(kit.Kit(ros=ros).drive(), said, tmp_path / "car.mcap")
    result, frames = run_ingest(log)
    assert (result.status, frames) == ("refused", [])
    assert result.reason.isprintable()
    assert f"car.mcap, topic /camera/info: sensor_msgs/msg/CameraInfo {why}" in result.reason
    assert result.rejected["wrong_encoding"] > 4


def test_a_ros_1_bag_with_type_names_of_ros_2_is_read(kit, tmp_path, run_ingest, monkeypatch):
    monkeypatch.setattr(rosbags.rosbag1.writer, "denormalize_msgtype", lambda name: name)
    log = kit.Kit(ros=1).drive().bag(tmp_path / "a.bag")
    assert b"type=sensor_msgs/msg/PointCloud2" in log.read_bytes()
    assert run_ingest(log)[0].status == "done"


@pytest.mark.parametrize("said", ["cdr", "ros1"])
@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", b"\0" * 40, b"\xff" * 40, bytes(range(64))])
def test_bytes_that_do_not_tell_are_left_to_whoever_decodes_them(said, data):
    assert encoding_fault(Channel("/a", "sensor_msgs/msg/Image", said), memoryview(data)) == ""

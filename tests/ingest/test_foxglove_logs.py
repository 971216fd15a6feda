"""A Foxglove log gives the rows that the ROS log of the same drive gives, to the last bit."""

from dataclasses import fields, replace

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from pipeline.core.errors import LogError
from pipeline.ingest.check import check_logs
from pipeline.ingest.containers.reader import BYTES_AS_TEXT, PROTOBUF, Channel
from pipeline.ingest.messages.decoding import decode, header_stamp_ns
from tests.makers import foxglove_logs

RNG = np.random.default_rng(0)


def assert_same_rows(frames, others):
    assert len(frames) == len(others) > 0
    for a, b in zip(frames, others, strict=True):
        for f in fields(a):
            if f.name != "log":
                np.testing.assert_equal(getattr(a, f.name), getattr(b, f.name), err_msg=f.name)


def test_a_foxglove_log_gives_the_rows_of_the_ros_log(kit, tmp_path, run_ingest):
    made = kit.Kit().drive().driven(10.0, 0.4)
    _, ros = run_ingest(made.mcap(tmp_path / "ros.mcap"), name="a")
    result, protobuf = run_ingest(foxglove_logs.write(made, tmp_path / "foxglove.mcap"), name="b")
    assert result.status == "done"
    assert ros[0].lidar_deskewed
    assert "lidar_radar" in ros[0].priors
    assert_same_rows(ros, protobuf)


def test_raw_images_of_foxglove_are_those_of_ros(kit, tmp_path, run_ingest):
    made = kit.Kit().drive()
    for i in range(4):
        stamp = kit.START_NS + i * kit.PERIOD_NS + 1_000_000
        pixels = RNG.integers(0, 255, (kit.HEIGHT, kit.WIDTH, 3), np.uint8)
        made.replaced(kit.IMAGE, i, made.image(stamp, pixels, "rgb8", step=3 * kit.WIDTH + 5))
        made.replaced(kit.LABELS, i, made.image(stamp, pixels[..., 0] % 19, "mono8"))
    _, ros = run_ingest(made.mcap(tmp_path / "ros.mcap"), name="a")
    _, protobuf = run_ingest(foxglove_logs.write(made, tmp_path / "foxglove.mcap"), name="b")
    assert ros[0].labels_png is not None
    assert_same_rows(ros, protobuf)


def test_transforms_one_by_one_on_a_topic_of_their_own_give_the_prior(kit, tmp_path, run_ingest):
    made = kit.Kit().drive()
    _, _, log_time, tf = made.messages.pop(0)
    singles = [("/tf", "tf2_msgs/msg/TFMessage", log_time, made.tf(t)) for t in tf.transforms]
    alone = replace(made, messages=[*singles, *made.messages])

    def one(message):
        is_tf = message.__msgtype__ == "tf2_msgs/msg/TFMessage"
        return foxglove_logs.transform(message.transforms[0]) if is_tf else foxglove_logs.foxglove(message)

    log = foxglove_logs.write(alone, tmp_path / "foxglove.mcap", one)
    _, without = run_ingest(log, name="a")
    assert without[0].priors == {}
    _, frames = run_ingest(log, fleet=kit.fleet(prior={"topic": "/tf"}), name="b")
    assert "camera_lidar" in frames[0].priors


def test_the_ros_2_messages_of_foxglove_are_read_too(kit, tmp_path, run_ingest):
    made = kit.Kit().drive()
    _, ros = run_ingest(made.mcap(tmp_path / "ros.mcap"), name="a")
    kinds = {
        "foxglove_msgs/msg/CompressedImage": (
            "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
        ),
        "foxglove_msgs/msg/CameraCalibration": (
            "builtin_interfaces/Time timestamp\nstring frame_id\nuint32 width\nuint32 height\n"
            "string distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\n"
        ),
    }
    for name, text in kinds.items():
        made.store.register(get_types_from_msg(text, name))
    twins = {f"sensor_msgs/msg/{ros}": f"foxglove_msgs/msg/{its}" for ros, its in
             [("CompressedImage", "CompressedImage"), ("CameraInfo", "CameraCalibration")]}  # fmt: skip

    def twin(message):
        kind = made.store.types[twins[message.__msgtype__]]
        same = {
            n: getattr(message, n)
            for n, _ in made.store.fielddefs[kind.__msgtype__][1]
            if hasattr(message, n)
        }
        return kind(timestamp=message.header.stamp, frame_id=message.header.frame_id, **same)

    made.messages = [
        (topic, twins.get(kind, kind), t, twin(m) if kind in twins else m)
        for topic, kind, t, m in made.messages
    ]
    _, frames = run_ingest(made.mcap(tmp_path / "foxglove.mcap"), name="b")
    assert_same_rows(ros, frames)


def test_a_camera_that_says_nothing_of_its_lens_is_left_out_by_name(kit, tmp_path, run_ingest):
    made = kit.Kit().drive()
    made.each(kit.INFO, lambda _, at: made.info(at, focal_px=0.0))
    result, frames = run_ingest(foxglove_logs.write(made, tmp_path / "foxglove.mcap"))
    assert not any("camera" in f.sensors for f in frames)
    assert "the camera is not calibrated" in result.reason


def test_a_laser_scan_and_a_posed_cloud_are_refused_with_the_reason(kit, tmp_path, run_ingest):
    made = kit.Kit().drive()

    def scan(message):
        said = foxglove_logs.foxglove(message)
        if message.__msgtype__.endswith("PointCloud2") and said.frame_id == "radar":
            return foxglove_logs.schema("LaserScan")(
                timestamp=said.timestamp, frame_id="radar", ranges=[3.0, 4.0]
            )
        return said

    def posed(message):
        said = foxglove_logs.foxglove(message)
        if message.__msgtype__.endswith("PointCloud2"):
            said.pose.position.x = 1.5
        return said

    result, _ = run_ingest(foxglove_logs.write(made, tmp_path / "scan.mcap", scan), name="a")
    assert result.rejected["without_radar_no_radar_in_gate"] == 4
    assert "it has no Doppler" in result.reason
    result, _ = run_ingest(foxglove_logs.write(made, tmp_path / "posed.mcap", posed), name="b")
    assert (result.status, "give the sensor a frame of its own" in result.reason) == ("refused", True)


def is_refused(channel, data):
    try:
        decode(channel, memoryview(data))
    except LogError as err:
        return channel.topic in str(err)
    return False


def test_damaged_protobuf_bytes_are_an_error_that_names_the_topic_and_never_another(kit):
    made = kit.Kit()
    cloud = foxglove_logs.foxglove(made.cloud(kit.START_NS, kit.lidar(0)))
    schema = foxglove_logs.descriptors(cloud).decode(BYTES_AS_TEXT)
    channel = Channel(kit.LIDAR, "foxglove.PointCloud", PROTOBUF, schema, PROTOBUF)
    whole, refused = cloud.SerializeToString(), 0
    assert header_stamp_ns(channel, memoryview(whole)) == kit.START_NS
    for trial in range(60):
        damaged = bytearray(whole)
        place = trial if trial < 40 else int(np.random.default_rng(trial).integers(len(whole)))
        damaged[place] ^= 0xFF
        assert header_stamp_ns(channel, memoryview(damaged)) != kit.START_NS or place > 8
        refused += is_refused(channel, damaged[: None if trial % 2 else len(whole) // 2])
    assert refused >= 30  # of those cut in half at the least


def test_a_protobuf_channel_without_a_schema_is_refused_in_words(kit):
    with pytest.raises(LogError, match="schema"):
        decode(Channel(kit.LIDAR, "foxglove.PointCloud", PROTOBUF, "", PROTOBUF), memoryview(b""))


def test_check_says_of_a_foxglove_log_what_it_says_of_the_ros_log(kit, tmp_path):
    made, fleet = kit.Kit().drive().driven(10.0, 0.4), kit.fleet()
    logs = made.mcap(tmp_path / "ros.mcap"), foxglove_logs.write(made, tmp_path / "foxglove.mcap")
    ros, protobuf = (check_logs([log], fleet.rig_of("car"), fleet) for log in logs)
    assert {t.problem for t in protobuf.topics} == {""}
    assert "foxglove.PointCloud" in {kind for t in protobuf.topics for kind in t.types}
    assert replace(protobuf, topics=[]) == replace(ros, topics=[])

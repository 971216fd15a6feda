"""The same drive comes out of every container the same, bit for bit."""

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
import zstandard

from pipeline.rig.se3 import to_quaternion

MCAP = {
    "mcap": {}, "mcap_lz4": {"compression": "LZ4"}, "mcap_plain": {"compression": "NONE"},
    "mcap_unchunked": {"use_chunking": False},
}  # fmt: skip
BAGS = {"bag": None, "bag_lz4": "LZ4", "bag_bz2": "BZ2"}


def edited(file, edit):
    with sqlite3.connect(file) as db:
        edit(db)
    db.close()


def with_packed_messages(db):
    rows = db.execute("SELECT id, data FROM messages").fetchall()
    packed = [(zstandard.ZstdCompressor().compress(data), i) for i, data in rows]
    db.executemany("UPDATE messages SET data = ? WHERE id = ?", packed)


def without_definitions(db):
    db.execute("DROP TABLE message_definitions")  # as ROS 2 up to Humble


def packed_whole(file):
    Path(f"{file}.zstd").write_bytes(zstandard.ZstdCompressor().compress(file.read_bytes()))
    file.unlink()


# What befalls the file of a ROS 2 bag.
FOLDERS = {
    "db3": lambda _: None,
    "db3_without_metadata": lambda file: (file.parent / "metadata.yaml").unlink(),
    "db3_zstd": packed_whole,
    "db3_packed_messages": lambda file: edited(file, with_packed_messages),
    "db3_without_definitions": lambda file: edited(file, without_definitions),
}


def write(kit, tmp_path, container, **options):
    """The log of a drive in this container; `options` as of Kit."""
    if container in BAGS:
        return kit.Kit(ros=1, **options).drive().bag(tmp_path / f"{container}.bag", BAGS[container])
    drive = kit.Kit(**options).drive()
    if container in MCAP:
        return drive.mcap(tmp_path / f"{container}.mcap", **MCAP[container])
    if container == "mcap_folder":
        return drive.folder(tmp_path / container, "MCAP")
    folder = drive.folder(tmp_path / container)
    file = next(folder.glob("*.db3"))
    if container == "db3_file":
        return file
    FOLDERS[container](file)
    return folder


@pytest.mark.parametrize("container", [*MCAP, *BAGS, *FOLDERS, "db3_file", "mcap_folder"])
def test_every_container_gives_every_frame_as_logged(kit, tmp_path, run_ingest, container):
    log = write(kit, tmp_path, container)
    result, frames = run_ingest(log)
    assert (result.status, result.rows, result.rejected, result.reason) == ("done", 4, {}, "")
    for i, frame in enumerate(frames):
        columns, scan = kit.lidar(i), kit.radar(i)
        assert frame.frame_index == i
        assert frame.log == log.name
        assert frame.stamp_ns == frame.lidar_stamp_ns == kit.START_NS + i * kit.PERIOD_NS
        assert frame.camera_stamp_ns == frame.stamp_ns + 1_000_000
        assert frame.radar_stamp_ns == frame.stamp_ns - 2_000_000
        assert frame.image == kit.jpeg(i)
        assert frame.labels_png == kit.label_png(i)
        assert frame.image_format == "jpeg"
        assert (frame.image_width_px, frame.image_height_px) == (kit.WIDTH, kit.HEIGHT)
        np.testing.assert_array_equal(frame.lidar_xyz_m, np.stack([columns[n] for n in "xyz"], -1))
        np.testing.assert_array_equal(frame.lidar_intensity, columns["intensity"])
        np.testing.assert_array_equal(frame.lidar_ring, columns["ring"])
        np.testing.assert_array_equal(frame.lidar_time_s, columns["time"])
        np.testing.assert_array_equal(frame.radar_xyz_m, np.stack([scan[n] for n in "xyz"], -1))
        np.testing.assert_array_equal(frame.radar_range_rate_mps, -scan["doppler"])
        np.testing.assert_allclose(frame.detection_boxes_px, [[15 + i, 26, 25 + i, 34]])
        assert frame.detection_classes == ["car"]
        assert frame.ego_speed_mps is None
        assert not frame.lidar_deskewed
        assert frame.priors["lidar_radar"][0, 3] == pytest.approx(2.6)
        assert to_quaternion(frame.priors["camera_lidar"])[0] == pytest.approx(0.5)


def test_an_old_ros2_bag_without_definitions_is_read_by_those_of_its_distribution(kit, tmp_path, run_ingest):
    drive = kit.Kit().drive()
    values = {"range": 10.0, "azimuth": 0.1, "elevation": 0.0, "doppler_velocity": -3.0, "amplitude": 9.0}
    one = drive.new("radar_msgs/msg/RadarReturn", **values)
    kind = "radar_msgs/msg/RadarScan"
    drive.each(kit.RADAR, lambda _, at: drive.new(kind, header=drive.header(at, "radar"), returns=[one]))
    folder = drive.folder(tmp_path / "bag")
    edited(next(folder.glob("*.db3")), without_definitions)
    assert [len(f.radar_xyz_m) for f in run_ingest(folder)[1]] == [1] * 4


def test_a_recording_split_by_time_is_one_day_and_its_first_file_holds_the_transforms(
    kit, tmp_path, run_ingest
):
    first = kit.Kit().drive().mcap(tmp_path / "a.mcap")
    second = kit.Kit().drive(kit.START_NS + 4 * kit.PERIOD_NS).without("/tf_static").mcap(tmp_path / "b.mcap")
    _, frames = run_ingest(second, first)
    assert [f.log for f in frames] == ["a.mcap"] * 4 + ["b.mcap"] * 4
    assert [f.drive for f in frames] == [0] * 4 + [1] * 4
    assert all("camera_lidar" in f.priors for f in frames)


def test_a_recording_split_by_sensor_still_gives_trios(kit, tmp_path, run_ingest):
    logs = []
    for topic in (kit.IMAGE, kit.LIDAR, kit.RADAR):
        drive = kit.Kit().drive()
        for other in {kit.IMAGE, kit.LIDAR, kit.RADAR} - {topic}:
            drive.without(other)
        logs.append(drive.mcap(tmp_path / f"{topic.split('/')[1]}.mcap"))
    result, frames = run_ingest(*logs)
    assert result.rows == 4
    assert {f.log for f in frames} == {"lidar.mcap"}


def test_the_same_log_given_twice_gives_each_frame_once(kit, tmp_path, run_ingest):
    log = kit.Kit().drive().mcap(tmp_path / "a.mcap")
    copy = tmp_path / "copy.mcap"
    shutil.copy(log, copy)
    result, frames = run_ingest(log, copy)
    assert len(frames) == 4
    assert result.rejected == {"duplicate_stamp": 4}

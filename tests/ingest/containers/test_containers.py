"""The same drive comes out of every container the same, bit for bit."""

import shutil

import numpy as np
import pytest
import zstandard

from pipeline.rig.se3 import to_quaternion

CONTAINERS = (
    "mcap",
    "mcap_lz4",
    "mcap_plain",
    "mcap_unchunked",
    "bag",
    "bag_lz4",
    "bag_bz2",
    "db3",
    "db3_file",
    "mcap_folder",
)


def write(kit, tmp_path, container):
    if container.startswith("bag"):
        compression = {"bag": None, "bag_lz4": "LZ4", "bag_bz2": "BZ2"}[container]
        return kit.Kit(ros=1).drive().bag(tmp_path / f"{container}.bag", compression)
    drive = kit.Kit().drive()
    if container.startswith("db3"):
        folder = drive.folder(tmp_path / container)
        return folder if container == "db3" else next(folder.glob("*.db3"))
    if container == "mcap_folder":
        return drive.folder(tmp_path / container, "MCAP")
    options = {"mcap_lz4": {"compression": "LZ4"}, "mcap_plain": {"compression": "NONE"}}.get(container, {})
    if container == "mcap_unchunked":
        options = {"use_chunking": False}
    return drive.mcap(tmp_path / f"{container}.mcap", **options)


@pytest.mark.parametrize("container", CONTAINERS)
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


def test_a_folder_without_its_metadata_is_read_by_its_files(kit, tmp_path, run_ingest):
    folder = kit.Kit().drive().folder(tmp_path / "bag")
    (folder / "metadata.yaml").unlink()
    assert run_ingest(folder)[0].rows == 4


def test_a_compressed_bag_file_is_unpacked(kit, tmp_path, run_ingest):
    folder = kit.Kit().drive().folder(tmp_path / "bag")
    plain = next(folder.glob("*.db3"))
    (folder / f"{plain.name}.zstd").write_bytes(zstandard.ZstdCompressor().compress(plain.read_bytes()))
    plain.unlink()
    result, frames = run_ingest(folder)
    assert result.rows == 4
    assert frames[3].image == kit.jpeg(3)


def test_singly_compressed_messages_of_a_ros2_bag_are_unpacked(kit, tmp_path, run_ingest):
    folder = kit.Kit().drive().folder(tmp_path / "bag")
    with kit.sqlite.connect(next(folder.glob("*.db3"))) as db:
        rows = db.execute("SELECT id, data FROM messages").fetchall()
        packed = [(zstandard.ZstdCompressor().compress(data), i) for i, data in rows]
        db.executemany("UPDATE messages SET data = ? WHERE id = ?", packed)
    db.close()
    result, frames = run_ingest(folder)
    assert result.rows == 4
    assert frames[2].labels_png == kit.label_png(2)


@pytest.mark.parametrize("kind", ["detections", "radar scan"])
def test_an_old_ros2_bag_without_definitions_is_read_by_those_of_its_distribution(
    kit, tmp_path, run_ingest, kind
):
    drive = kit.Kit().drive()
    if kind == "radar scan":
        for i in range(4):
            stamp = kit.START_NS + i * kit.PERIOD_NS
            drive.replaced(kit.RADAR, i, scan_message(drive, stamp))
    folder = drive.folder(tmp_path / "bag")
    with kit.sqlite.connect(next(folder.glob("*.db3"))) as db:
        db.execute("DROP TABLE message_definitions")
    db.close()
    result, frames = run_ingest(folder)
    assert result.rows == 4
    assert frames[0].detection_classes == ["car"]


def scan_message(drive, stamp):
    kind = "radar_msgs/msg/RadarReturn"
    one = drive.new(kind, range=10.0, azimuth=0.1, elevation=0.0, doppler_velocity=-3.0, amplitude=9.0)
    return drive.new("radar_msgs/msg/RadarScan", header=drive.header(stamp, "radar"), returns=[one])


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

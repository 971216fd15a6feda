"""Faulty logs: what is whole is kept, what is not is counted and named, nothing is made up."""

import dataclasses
import json
import os
import resource

import numpy as np
import pytest

from pipeline.core.errors import ConfigError, LogError
from pipeline.ingest.containers.mcap import McapLog
from pipeline.ingest.index import index_logs
from pipeline.ingest.sync import Rejection, none_near
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import ingested
from schemas.calibrations import SENSORS
from schemas.moments import SENSORS_ABSENT
from tests.ingest.containers.test_containers import write
from tests.makers.stages import ingest_day


def manifest_of(folder, name="lake"):
    return ingested(Lake.at(folder / name), Partition("car", "2023-11-14"))


def test_a_missing_file_or_unknown_vehicle_is_a_mistake_of_the_caller(kit, tmp_path, run_ingest):
    with pytest.raises(ConfigError, match="no such file"):
        run_ingest(tmp_path / "none.mcap")
    with pytest.raises(ConfigError, match="unknown vehicle"):
        run_ingest(tmp_path, fleet=kit.fleet(vehicles={"other": {}}))


def test_a_link_to_a_lost_log_is_named_with_where_it_leads(tmp_path, run_ingest):
    (tmp_path / "a.mcap").symlink_to("/unmounted/a.mcap")
    with pytest.raises(LogError, match=r"a\.mcap.* is a link to /unmounted/a\.mcap"):
        run_ingest(tmp_path / "a.mcap")


@pytest.mark.parametrize("name", ["a.mcap", "a.bag", "a.db3", "a.txt", "folder"])
@pytest.mark.parametrize("content", [b"", b"this is no log at all, only text" * 30])
def test_what_is_no_log_is_refused_by_name(tmp_path, run_ingest, name, content):
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    else:
        path.write_bytes(content)
    result, _ = run_ingest(path)
    assert result.status == "refused"
    assert name in result.reason


def test_one_bad_log_does_not_cost_the_others(kit, tmp_path, run_ingest):
    (tmp_path / "bad.bag").write_bytes(b"rubbish")
    result, frames = run_ingest(tmp_path / "bad.bag", kit.Kit().drive().mcap(tmp_path / "good.mcap"))
    assert (result.status, len(frames)) == ("done", 4)
    assert result.rejected["unreadable_logs"] == 1
    assert "bad.bag" in result.reason


@pytest.fixture
def few_open_files():
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (128, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.mark.usefixtures("few_open_files")
def test_a_day_in_more_logs_than_a_process_may_open_at_first_is_read_whole(kit, tmp_path):
    log = kit.Kit().drive().mcap(tmp_path / "0.mcap")
    logs = [log, *(tmp_path / f"{i}.mcap" for i in range(1, 200))]
    for other in logs[1:]:
        os.link(log, other)
    index = index_logs(logs, kit.fleet().rig_of("car"))
    assert (len(index.logs), index.problems) == (200, [])
    index.close()


def test_a_disk_that_fails_half_way_costs_the_rest_of_the_log(kit, tmp_path, run_ingest, monkeypatch):
    log = kit.Kit(frames=20).drive().mcap(tmp_path / "a.mcap")
    whole, reads = McapLog._content, []

    def failing(self, start, length):
        reads.append(start)
        if len(reads) == 30:
            raise OSError(5, "Input/output error")
        return whole(self, start, length)

    monkeypatch.setattr(McapLog, "_content", failing)
    result, frames = run_ingest(log)
    assert 0 < len(frames) < 20
    assert "Input/output error" in result.reason
    assert result.rejected["logs_lost_while_reading"] == 1


@pytest.mark.parametrize("container", ["mcap", "bag", "db3_file"])
def test_a_recording_cut_off_keeps_the_frames_before_the_cut(kit, tmp_path, run_ingest, container):
    log = write(kit, tmp_path, container, frames=20)
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.6)])
    result, frames = run_ingest(log)
    assert result.status == "done"
    assert 6 <= len(frames) <= 12
    assert [f.image for f in frames] == [kit.jpeg(i) for i in range(len(frames))]
    assert result.reason
    assert set(result.rejected) & {"truncated", "damaged_rows", "damaged_chunks"}


@pytest.mark.parametrize("place", [0.5, 600], ids=["in the middle", "in the first chunk"])
def test_a_flipped_bit_costs_one_chunk_of_an_mcap_and_no_channel(kit, tmp_path, run_ingest, place):
    log = kit.Kit(frames=20).drive().mcap(tmp_path / "a.mcap", compression="NONE")
    data = bytearray(log.read_bytes())
    data[int(place * len(data)) if place < 1 else place] ^= 4
    log.write_bytes(data)
    result, frames = run_ingest(log)
    assert 14 <= len(frames) < 20
    assert result.rejected["damaged_chunks"] == 1
    assert "damaged chunks" in result.reason
    for f in frames:
        assert f.image == kit.jpeg((f.stamp_ns - kit.START_NS) // kit.PERIOD_NS)


def test_reordered_and_repeated_messages_give_each_frame_once_in_order(kit, tmp_path, run_ingest):
    drive = kit.Kit(frames=6).drive()
    order = np.random.default_rng(0).permutation(len(drive.messages))
    repeated = [i for i, m in enumerate(drive.messages) if m[0] in (kit.LIDAR, kit.IMAGE)][:4]
    drive.messages = [drive.messages[i] for i in (*order, *repeated)]
    result, frames = run_ingest(drive.mcap(tmp_path / "a.mcap"))
    assert [f.stamp_ns for f in frames] == [kit.START_NS + i * kit.PERIOD_NS for i in range(6)]
    assert [f.image for f in frames] == [kit.jpeg(i) for i in range(6)]
    assert result.rejected["duplicate_stamp"] == 2


@pytest.mark.parametrize(
    ("topic", "sensor"), [("IMAGE", "camera"), ("LIDAR", "lidar"), ("RADAR", "radar"), ("INFO", "camera")]
)
def test_a_sensor_that_is_missing_is_named_by_its_topic_and_leaves_the_others(
    kit, tmp_path, run_ingest, topic, sensor
):
    name = getattr(kit, topic)
    result, frames = run_ingest(kit.Kit().drive().without(name).mcap(tmp_path / "a.mcap"))
    assert (result.status, result.rows) == ("done", 4)
    assert name in result.reason
    assert all(set(f.sensors) == set(SENSORS) - {sensor} for f in frames)
    assert sum(n for key, n in result.rejected.items() if key.startswith(f"without_{sensor}_")) == 4
    assert name in manifest_of(tmp_path).extra[SENSORS_ABSENT][sensor]
    if sensor == "lidar":
        assert all(set(f.priors) == {"camera_radar"} for f in frames)
        assert all(f.stamp_ns == f.radar_stamp_ns for f in frames)


def test_a_day_of_one_sensor_is_refused_by_the_topics_of_the_others(kit, tmp_path, run_ingest):
    drive = kit.Kit().drive().without(kit.RADAR).without(kit.IMAGE)
    result, _ = run_ingest(drive.mcap(tmp_path / "a.mcap"))
    assert (result.status, result.rows) == ("refused", 0)
    assert kit.RADAR in result.reason
    assert kit.IMAGE in result.reason
    assert Lake.at(tmp_path / "lake").partitions("moments") == []


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_rig_without_a_sensor_reads_the_other_two(kit, tmp_path, run_ingest, sensor):
    fleet = kit.fleet()
    rig = fleet.rigs["default"].model_copy(update={f"{sensor}s": {}})
    fleet = fleet.model_copy(update={"rigs": {"default": rig}})
    result, frames = run_ingest(kit.Kit().drive().mcap(tmp_path / "a.mcap"), fleet=fleet)
    assert (result.status, result.rows) == ("done", 4)
    assert all(set(f.sensors) == set(SENSORS) - {sensor} for f in frames)
    assert not any(key.startswith("without_") for key in result.rejected)
    assert not any(key.startswith("frames_without") for key in result.rejected)


def test_a_definition_that_does_not_fit_its_bytes_is_refused_not_guessed(kit, tmp_path, run_ingest):
    log = kit.Kit().drive().mcap(tmp_path / "a.mcap", compression="NONE", enable_crcs=False)
    data = log.read_bytes()
    assert b"uint32 point_step" in data
    log.write_bytes(data.replace(b"uint32 point_step", b"uint16 point_step"))
    result, _ = run_ingest(log)
    assert result.status == "refused"
    assert result.rejected[Rejection.LIDAR_DAMAGED] == 4


def test_each_fault_of_one_frame_costs_that_frame_under_its_own_name(kit, tmp_path, run_ingest):
    drive = kit.Kit(frames=12).drive()
    start, period = kit.START_NS, kit.PERIOD_NS
    jpeg = kit.jpeg(1)
    drive.replaced(kit.IMAGE, 1, drive.compressed(start + period, jpeg[:-200]))
    drive.replaced(kit.IMAGE, 2, drive.compressed(start + 2 * period, b"no image"))
    empty = {n: np.zeros(0, "f4") for n in "xyz"}
    drive.replaced(kit.LIDAR, 3, drive.cloud(start + 3 * period, empty))
    drive.replaced(kit.LIDAR, 4, drive.cloud(start + 4 * period, {"range": np.ones(900, "f4")}))
    drive.replaced(kit.RADAR, 5, drive.cloud(start + 5 * period, empty | {"doppler": np.zeros(0, "f4")}))
    drive.replaced(kit.RADAR, 6, drive.cloud(start + 6 * period, kit.lidar(0)))
    drive.replaced(kit.IMAGE, 7, drive.compressed(start + 7 * period + 20_000_000, kit.jpeg(7)))
    drive.replaced(kit.RADAR, 8, drive.cloud(start + 8 * period + 9_000_000, kit.radar(8)))
    small = drive.image(start + 9 * period, np.zeros((5, 6, 3), np.uint8), "rgb8")
    drive.replaced(kit.IMAGE, 9, small)
    drive.replaced(kit.LIDAR, 10, drive.cloud(0, kit.lidar(10)))
    paper = kit.fleet(ingest={"sync_gate_s": 0.005})
    result, frames = run_ingest(drive.mcap(tmp_path / "a.mcap"), fleet=paper)
    assert [(f.stamp_ns - start) // period for f in frames] == [0, 11]
    assert [f.frame_index for f in frames] == [0, 1]
    reasons = {*Rejection, none_near("camera"), none_near("radar")}
    counted = {k: v for k, v in result.rejected.items() if k in reasons}
    assert counted == {
        "image_damaged": 2, "too_few_lidar_points": 1, "lidar_undecodable": 1, "too_few_radar_points": 1,
        "radar_undecodable": 1, "no_camera_in_gate": 1, "no_radar_in_gate": 1,
        "image_size_differs_from_camera_info": 1,
    }  # fmt: skip
    assert result.rejected["lidar_without_stamp"] == 1
    assert result.rows + sum(counted.values()) == 11  # every sweep that has a stamp is accounted for


def test_an_image_that_is_late_by_as_much_as_all_others_costs_nothing_and_one_that_is_late_alone_goes(
    kit, tmp_path, run_ingest
):
    drive, late = kit.Kit(frames=24).drive().driven(100.0), 40_000_000

    def image(i, at):
        return drive.compressed(at + late + (30_000_000 if i == 5 else 0), kit.jpeg(i))

    drive.each(kit.IMAGE, image)
    log = drive.mcap(tmp_path / "a.mcap")
    result, frames = run_ingest(log)
    assert [f.frame_index for f in frames] == list(range(23))
    assert {f.camera_stamp_ns - f.stamp_ns for f in frames} == {late}
    assert result.rejected["no_camera_in_gate"] == 1
    _, without = run_ingest(log, fleet=kit.fleet(ingest={"sync_gate_s": 0.005}), name="paper")
    assert {tuple(f.sensors) for f in without} == {("lidar", "radar")}
    assert "leave it out to gate by motion" in manifest_of(tmp_path, "paper").extra[SENSORS_ABSENT]["camera"]


@pytest.mark.parametrize(
    ("spoil", "counts", "words"),
    [
        (
            lambda drive, kit: drive.each(kit.RADAR, lambda _, at: drive.info(at)),
            {"wrong_type": 4, "without_radar_no_radar_in_gate": 4},
            "/radar/points: sensor_msgs/msg/CameraInfo, not sensor_msgs/msg/PointCloud2",
        ),
        (
            lambda drive, kit: drive.each(kit.INFO, lambda _, at: drive.info(at, focal_px=0.0)),
            {"camera_info_unusable": 4, "without_camera_no_usable_camera_info": 4},
            "zero K",
        ),
        (
            lambda drive, _: drive.without("/tf_static"),
            {"frames_without_prior": 4},
            "/tf_static has no chain from camera_optical to lidar: no prior",
        ),
    ],
    ids=["a wrong type", "no calibration", "no transforms"],
)
def test_what_a_whole_day_lacks_is_counted_and_named(kit, tmp_path, run_ingest, spoil, counts, words):
    result, frames = run_ingest(spoil(kit.Kit().drive(), kit).mcap(tmp_path / "a.mcap"))
    manifest = manifest_of(tmp_path)
    assert (result.status, manifest.rejected, manifest.kept) == ("done", result.rejected, {"frames": 4})
    assert result.rejected == counts
    assert words in result.reason
    assert any(words in problem for problem in manifest.extra["problems"])
    assert manifest.inputs[0].startswith("a.mcap:")
    if "camera_info_unusable" in counts:
        assert "CameraInfo with a calibrated K" in manifest.extra[SENSORS_ABSENT]["camera"]
    if "frames_without_prior" in counts:  # rather than an identity
        assert all(f.priors == {} for f in frames)


def test_damaged_labels_and_detections_are_absent_not_empty(kit, tmp_path, run_ingest):
    drive = kit.Kit().drive()
    drive.replaced(kit.LABELS, 1, drive.compressed(kit.START_NS + kit.PERIOD_NS, kit.jpeg(0)))
    drive.messages.pop([i for i, m in enumerate(drive.messages) if m[0] == kit.DETECTIONS][2])
    result, frames = run_ingest(drive.mcap(tmp_path / "a.mcap"))
    assert [f.labels_png is None for f in frames] == [False, True, False, False]
    assert [f.detection_boxes_px is None for f in frames] == [False, False, True, False]
    assert result.rejected["labels_damaged"] == 1
    assert result.rejected["frames_without_detections"] == 1


@pytest.mark.parametrize("old_types", [False, True])
def test_detections_of_both_versions_give_boxes_and_those_without_a_size_are_counted(
    kit, tmp_path, run_ingest, old_types
):
    drive = kit.Kit(old_types=old_types).drive()
    boxes = [
        (50.0, 20.0, 20.0, 10.0, "bus", 0.5),
        (9.0, 9.0, 0.0, 4.0, "car", 0.9),
        (np.nan, 9.0, 3.0, 4.0, "car", 0.9),
    ]
    drive.replaced(kit.DETECTIONS, 0, drive.detections(kit.START_NS + 1_000_000, boxes))
    result, frames = run_ingest(drive.mcap(tmp_path / "a.mcap"))
    np.testing.assert_array_equal(frames[0].detection_boxes_px, [[40, 15, 60, 25]])
    assert frames[0].detection_classes == ["bus"]
    np.testing.assert_array_equal(frames[0].detection_scores, [0.5])
    assert result.rejected["detections_without_box_or_class"] == 2


def test_an_unchanged_day_is_cached_and_a_changed_one_is_made_anew(kit, tmp_path, run_ingest):
    log = kit.Kit().drive().mcap(tmp_path / "a.mcap")
    first, _ = run_ingest(log)
    second, frames = run_ingest(log)
    assert (second.status, second.work_key, second.rows) == ("cached", first.work_key, 4)
    assert len(frames) == 4
    other = run_ingest(log, fleet=kit.fleet(ingest={"sync_gate_s": 0.0004}))[0]
    assert (other.status, other.rows) == ("refused", 0)
    assert "within 0.4 ms" in other.reason
    assert manifest_of(tmp_path).work_key == first.work_key  # a refused day leaves the lake as it was
    again = run_ingest(kit.Kit(frames=5).drive().mcap(tmp_path / "a.mcap"))[0]
    assert (again.status, again.rows) == ("done", 5)
    assert again.work_key != first.work_key


@pytest.mark.parametrize(
    ("day", "is_far"), [("2023-11-13", False), ("2023-11-15", False), ("2023-11-18", True)]
)
def test_a_day_whose_sweeps_are_stamped_far_from_it_is_named(day, is_far, kit, tmp_path):
    log = kit.Kit().drive().mcap(tmp_path / "a.mcap")  # stamped on the evening of the 14th
    result = ingest_day([log], Partition("car", day), kit.fleet(), Lake.at(tmp_path / "lake"))
    assert (f"stamped 2023-11-14 22:13 UTC, far from the day {day}" in result.reason) == is_far


def test_max_frames_keeps_an_even_spread_and_counts_the_rest(kit, tmp_path, run_ingest):
    log = kit.Kit(frames=21).drive().mcap(tmp_path / "a.mcap")
    result, frames = run_ingest(log, fleet=kit.fleet(ingest={"max_frames": 5}))
    assert [(f.stamp_ns - kit.START_NS) // kit.PERIOD_NS for f in frames] == [0, 5, 10, 15, 20]
    assert result.rejected == {"beyond_max_frames": 16}


def test_a_prior_file_stands_in_for_tf_static_and_enters_the_work_key(kit, tmp_path, run_ingest):
    log = kit.Kit().drive().mcap(tmp_path / "a.mcap")
    file, T = tmp_path / "prior.json", np.eye(4)
    fleet = kit.fleet(prior={"source": "file", "file": "prior.json"})

    def run(x_m=None, scale=1.0):
        T[0, 0], T[0, 3] = scale, x_m or 0.0
        if x_m is not None:
            file.write_text(json.dumps({"T_camera_lidar": T.tolist(), "T_lidar_radar": np.eye(4).tolist()}))
        return run_ingest(log, fleet=fleet, file=str(tmp_path / "fleet.toml"))

    with pytest.raises(ConfigError, match=r"prior\.json"):
        run()
    first, frames = run(0.25)
    np.testing.assert_array_equal(frames[0].priors["camera_lidar"], T)
    assert run(0.5)[0].work_key != first.work_key
    with pytest.raises(ConfigError, match="no rotation"):
        run(0.5, scale=2.0)


@pytest.mark.parametrize(
    ("topic", "sensor", "reason"),
    [
        ("IMAGE", "camera", Rejection.IMAGE_REPEATED),
        ("LIDAR", "lidar", Rejection.LIDAR_REPEATED),
        ("RADAR", "radar", Rejection.RADAR_REPEATED),
    ],
)
def test_data_that_a_sensor_repeats_under_new_stamps_are_counted_and_named(
    kit, tmp_path, run_ingest, topic, sensor, reason
):
    log = kit.Kit(frames=12).drive()
    held = next(m[3] for m in log.messages if m[0] == getattr(kit, topic))
    log.messages = [
        (*m[:3], dataclasses.replace(held, header=m[3].header)) if m[0] == getattr(kit, topic) else m
        for m in log.messages
    ]
    result, frames = run_ingest(log.mcap(tmp_path / "a.mcap"))
    assert sum(sensor in f.sensors for f in frames) == 1
    assert result.rejected[reason] + result.rejected.get(f"without_{sensor}_{reason}", 0) == 11

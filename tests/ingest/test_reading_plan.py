"""A long day is read in bursts: only their bytes, and every row as a day read whole would have it."""

from dataclasses import fields

import numpy as np
import pytest

from pipeline.ingest.containers.mcap import McapLog
from pipeline.ingest.containers.rosbag1 import BagLog
from pipeline.ingest.reading_plan import BURST_TRIOS
from tests.ingest.containers.test_containers import write
from tests.makers.written_logs import DETECTIONS, IMAGE, INFO, LABELS, LIDAR, RADAR

FRAMES, BUDGET = 200, 40
INDEXED = ("mcap", "mcap_plain", "bag", "bag_lz4", "db3", "db3_file", "mcap_folder")


def long_drive(kit, odometry=True, late_ns=0, late=(IMAGE,)):
    """Frames at 10 Hz: the first half parked, then ever faster; images are logged late."""
    drive = kit.Kit(frames=FRAMES).drive()
    if late_ns:
        drive.messages = [(t, k, at + late_ns * (t in late), m) for t, k, at, m in drive.messages]
    for i in range(2 * FRAMES if odometry else 0):
        stamp = kit.START_NS + i * kit.PERIOD_NS // 2
        speed = max(0.0, (i - FRAMES) * 0.1)
        drive.add(
            kit.ODOMETRY, "nav_msgs/msg/Odometry", stamp, drive.odometry(stamp, 20.0 * speed, 0, speed, 0)
        )
    drive.messages.sort(key=lambda m: m[2])
    return drive


def in_bursts(kit, **ingest):
    return kit.fleet(ingest={"read_sweeps": BUDGET} | ingest)


def frame_numbers(kit, frames):
    return np.array([(f.stamp_ns - kit.START_NS) // kit.PERIOD_NS for f in frames])


def same_but_numbers(a, b):
    for f in fields(a):
        if f.name not in ("frame_index", "drive", "priors"):
            np.testing.assert_array_equal(getattr(a, f.name), getattr(b, f.name), f.name)


@pytest.fixture(scope="module")
def day(kit, tmp_path_factory):
    return long_drive(kit).mcap(tmp_path_factory.mktemp("day") / "day.mcap")


def test_rows_of_bursts_are_those_of_the_whole_day_and_the_outcome_counts_them(kit, day, run_ingest):
    whole, every = run_ingest(day, fleet=kit.fleet(ingest={"read_sweeps": FRAMES}), name="whole")
    result, frames = run_ingest(day, fleet=in_bursts(kit), name="bursts")
    assert (whole.rows, whole.kept) == (FRAMES, {"frames": FRAMES})
    by_stamp = {f.stamp_ns: f for f in every}
    for frame in frames:
        same_but_numbers(frame, by_stamp[frame.stamp_ns])
    counts = {"sweeps_in_logs": FRAMES, "sweeps_planned": BUDGET, "sweeps_read": len(frames)}
    assert result.kept == {"frames": len(frames)} | counts
    assert (result.reason, result.rejected) == ("", {})
    assert abs(len(frames) - BUDGET) <= 2
    assert [f.frame_index for f in frames] == list(range(len(frames)))
    numbers = frame_numbers(kit, frames)  # runs of consecutive trios, of the driven part too
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    assert all(len(run) >= BURST_TRIOS - 1 for run in runs)
    assert np.sum(numbers > FRAMES // 2) >= BURST_TRIOS - 1


@pytest.mark.parametrize("container", INDEXED)
def test_every_container_with_an_index_is_read_in_bursts(kit, tmp_path, run_ingest, container):
    log = write(kit, tmp_path, container, frames=60)
    result, frames = run_ingest(log, fleet=kit.fleet(ingest={"read_sweeps": 20}))
    numbers = frame_numbers(kit, frames)
    assert (result.reason, result.rejected) == ("", {})
    assert result.kept["sweeps_in_logs"] == 60
    assert 19 <= len(numbers) <= 21
    assert np.all(np.diff(numbers) == 1)
    assert all("camera_lidar" in f.priors and f.labels_png is not None for f in frames)


@pytest.mark.parametrize("reader", ["mcap", "bag"])
def test_only_the_bytes_of_the_bursts_and_of_the_index_are_read(
    kit, tmp_path, run_ingest, monkeypatch, reader
):
    if reader == "mcap":
        log = long_drive(kit, odometry=False).mcap(tmp_path / "a.mcap", compression="NONE")
        kind = McapLog
    else:
        drive = kit.Kit(ros=1, frames=FRAMES).drive()
        log, kind = drive.bag(tmp_path / "a.bag", None), BagLog
    read, content = [], kind._content
    monkeypatch.setattr(kind, "_content", lambda *a: read.append(a[2]) or content(*a))
    _, frames = run_ingest(log, fleet=in_bursts(kit), name="bursts")
    size, part = log.stat().st_size, sum(read)
    assert len(frames) >= BUDGET - 2
    # 40 of 200 frames, half a second about each of 2 bursts, a second at 3 glances, and a chunk at each end.
    assert part < 0.6 * size
    read.clear()
    run_ingest(log, fleet=kit.fleet(ingest={"read_sweeps": "all"}), name="whole")
    assert sum(read) > 0.95 * size


@pytest.mark.parametrize(
    ("late_ns", "late", "why"),
    [
        (1_700_000_000, {IMAGE}, ""),
        (60 * 10**9, {IMAGE}, "log times do not follow the stamps"),
        (60 * 10**9, {IMAGE, INFO, LIDAR, RADAR, LABELS, DETECTIONS}, ""),  # the recorder's own clock
    ],
)
def test_images_that_are_logged_late_are_found_for_every_sweep_of_a_burst_if_need_be_by_a_whole_read(
    kit, tmp_path, run_ingest, late_ns, late, why
):
    log = long_drive(kit, odometry=len(late) == 1, late_ns=late_ns, late=late).mcap(tmp_path / "late.mcap")
    result, frames = run_ingest(log, fleet=in_bursts(kit))
    assert result.reason.startswith(f"{why}, so all of the day's 200 sweeps were read" if why else "")
    assert why or (result.reason, result.rejected) == ("", {})
    assert len(frames) == result.kept["sweeps_read"]
    assert abs(len(frames) - BUDGET) <= 2


def test_without_its_index_a_long_log_is_read_whole_to_take_bursts_and_is_named(
    kit, day, tmp_path, run_ingest
):
    data = bytearray(day.read_bytes())
    data[-60] ^= 0xFF  # in the summary: its checksum is wrong now
    log = tmp_path / "day.mcap"
    log.write_bytes(data)
    result, frames = run_ingest(log, fleet=in_bursts(kit))
    assert "day.mcap: no usable index, so all of the day's 200 sweeps were read" in result.reason
    assert abs(len(frames) - BUDGET) <= 2
    good = frame_numbers(kit, run_ingest(day, fleet=in_bursts(kit), name="good")[1])
    assert np.ptp(frame_numbers(kit, frames)) > 50
    assert np.isin(frame_numbers(kit, frames), good).mean() > 0.4  # much the same bursts


def test_a_log_without_index_among_others_is_left_unread_and_named(kit, day, tmp_path, run_ingest):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(day.read_bytes()[:-200])
    result, frames = run_ingest(day, cut, fleet=in_bursts(kit))
    assert "cut.mcap: not read: it has no usable index, and other logs have one" in result.reason
    assert result.rejected["logs_left_unread"] == 1
    assert {f.log for f in frames} == {"day.mcap"}


def test_a_day_split_into_files_has_bursts_of_many_and_transforms_of_the_first(kit, tmp_path, run_ingest):
    logs = []
    for part in range(6):
        drive = kit.Kit(frames=25).drive(kit.START_NS + part * 60 * 10**9)
        logs.append((drive if part == 0 else drive.without("/tf_static")).mcap(tmp_path / f"{part}.mcap"))
    result, frames = run_ingest(*logs, fleet=kit.fleet(ingest={"read_sweeps": 80}))
    assert len({f.log for f in frames}) >= 3
    assert all("camera_lidar" in f.priors for f in frames)
    assert result.kept["sweeps_in_logs"] == 150


@pytest.mark.parametrize("container", ["mcap", "bag", "folder"])
def test_of_sweeps_in_clumps_as_many_are_read_as_planned(kit, tmp_path, run_ingest, container):
    # Runs of 3 to 9 moments, 4 to 40 s apart: no stretch without pause is as long as a burst.
    made, at = kit.Kit(ros=1 if container == "bag" else 2), kit.START_NS
    rng = np.random.default_rng(3)
    for _ in range(30):
        made.frames = int(rng.integers(3, 10))
        made.drive(at)
        at += made.frames * kit.PERIOD_NS + int(rng.uniform(4, 40) * 1e9)
    log = getattr(made, container)(tmp_path / f"clumps{'.' * (container != 'folder')}{container}")
    result, frames = run_ingest(log, fleet=kit.fleet(ingest={"read_sweeps": 80}))
    assert (result.reason, result.rejected) == ("", {})
    assert result.kept["sweeps_planned"] == 80
    assert abs(len(frames) - 80) <= 8  # a chunk of one clump and a half does not say where its sweeps lie
    assert len({f.drive for f in frames}) > 8

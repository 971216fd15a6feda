"""The earlier image of each image: some metres before, once in the lake, and named where the log has none."""

import cv2
import numpy as np
import pytest

from pipeline.core.config import FleetConfig
from pipeline.store.moments import joined
from pipeline.store.partitions import Lake, Partition
from schemas.moments import MOMENTS
from tests.makers import written_logs
from tests.makers.stages import ingest_day
from tests.makers.written_logs import IMAGE, INFO, LIDAR, ODOMETRY, PERIOD_NS, RADAR, START_NS, Kit, jpeg

TWO_CAMERAS = {
    "fleet": {"name": "test"},
    "rigs": {
        "default": {
            "base": "base_link",
            "cameras": {"a": {"image": IMAGE, "info": INFO}, "b": {"image": "/b/image", "info": "/b/info"}},
            "ego": {"odometry": ODOMETRY},
        }
    },
    "vehicles": {"car": {}},
}
DAY = Partition("car", "2023-11-14")
FRAMES = 12


def drive(kit=None, speed_mps=10.0, yaw_rate=lambda _: 0.0):
    """A log of frames at 10 Hz with odometry at 50."""
    kit = kit or Kit(frames=FRAMES).drive()
    for k in range(-5, FRAMES * 5 + 5):
        t = k / 50
        stamp = START_NS + int(t * 1e9)
        message = kit.odometry(stamp, speed_mps * t, 0.0, speed_mps, yaw_rate(t))
        kit.add(ODOMETRY, "nav_msgs/msg/Odometry", stamp, message)
    return kit


def with_few_sweeps(kit):
    """Sweeps of every tenth frame alone: the others' images belong to no moment."""
    kit.messages = [m for m in kit.messages if m[0] != LIDAR or (m[2] - START_NS) % (10 * PERIOD_NS) == 0]
    return kit


@pytest.fixture
def images(tmp_path):
    def read(kit, **sections):
        lake = Lake.at(tmp_path / "lake")
        log = kit.mcap(tmp_path / "log.mcap")
        ingest_day([log], DAY, written_logs.fleet_config(**sections), lake)
        return [captures["camera"] for _, captures in joined(lake, MOMENTS, DAY) if "camera" in captures]

    return read


def test_images_of_moments_are_named_and_not_kept_again(images):
    found = images(drive())
    assert [row.earlier_missing for row in found[:1]] == ["no_earlier_image"]
    stamps = [row.stamp_ns for row in found]
    for k, row in enumerate(found[4:], 4):
        assert row.earlier_stamp_ns == stamps[k - 3]  # 3 m at 10 m/s
        assert row.earlier_image is None
        assert row.ego_driven_m == pytest.approx(3.0, abs=0.01)


def test_an_image_between_moments_is_kept_without_colour(images):
    row = images(with_few_sweeps(drive()))[1]
    pixels = cv2.imdecode(np.frombuffer(row.earlier_image, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels.shape == (written_logs.HEIGHT, written_logs.WIDTH)  # a small image: no smaller
    assert row.stamp_ns - row.earlier_stamp_ns == 3 * PERIOD_NS
    whole = cv2.imdecode(np.frombuffer(jpeg(7), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(pixels.astype(int) - whole).mean() < 6


def test_odometry_of_the_span_comes_with_it(images):
    found = images(drive(yaw_rate=lambda t: 0.5 * t))
    row = found[8]
    late = (row.stamp_ns - START_NS) * 1e-9
    assert row.ego_turned_rad == pytest.approx(0.25 * (late**2 - (late - 0.3) ** 2), rel=0.02)
    assert row.ego_turned_by_clock_radps == pytest.approx(0.15, rel=0.02)


def test_without_odometry_the_span_decides(images):
    row = images(Kit(frames=FRAMES).drive())[8]
    assert row.stamp_ns - row.earlier_stamp_ns == 3 * PERIOD_NS
    assert row.ego_driven_m is None


def test_a_standing_car_stamps_that_jump_and_a_picture_again_are_named(images):
    assert {row.earlier_missing for row in images(drive(speed_mps=0.0))[1:]} == {"standing"}

    kit = drive()
    for k, (topic, kind, logged, message) in enumerate(kit.messages):
        if topic == IMAGE and logged == START_NS + 5 * PERIOD_NS:
            message.header.stamp.nanosec += 200_000_000  # beyond the next two
            kit.messages[k] = (topic, kind, logged, message)
    assert "stamps_jump" in {row.earlier_missing for row in images(kit)}

    kit = with_few_sweeps(drive())
    for topic, _, logged, message in kit.messages:
        if topic == IMAGE and logged == START_NS + 7 * PERIOD_NS:
            message.data = np.frombuffer(jpeg(10), np.uint8)
    assert images(kit)[1].earlier_missing == "same_image_again"


@pytest.mark.parametrize(
    ("speed_mps", "reason"), [(30.0, "images_too_far_apart"), (0.1, "standing"), (6.0, None)]
)
def test_a_camera_too_slow_for_the_speed_is_named(images, speed_mps, reason):
    """At 2 Hz images lie 15 m apart at 30 m/s, and 3 m at 6 m/s."""
    kit = drive(speed_mps=speed_mps)
    kit.messages = [m for m in kit.messages if m[0] != IMAGE or (m[2] - START_NS) % (5 * PERIOD_NS) == 0]
    first, *others = images(kit)
    assert first.earlier_missing == ("standing" if speed_mps < 0.3 else "no_earlier_image")
    assert {row.earlier_missing for row in others} == {reason}


def test_a_car_with_cameras_alone_has_moments_of_its_images(tmp_path):
    kit = drive()
    kit = kit.without(LIDAR).without(RADAR)
    for k, (topic, kind, logged, message) in list(enumerate(kit.messages)):
        if topic == IMAGE:
            kit.add("/b/image", kind, logged, kit.compressed(logged + 3_000_000, jpeg(50 + k)))
        if topic == INFO:
            kit.add("/b/info", kind, logged, message)
    lake, log = Lake.at(tmp_path / "lake"), kit.mcap(tmp_path / "log.mcap")
    ingest_day([log], DAY, FleetConfig.model_validate(TWO_CAMERAS), lake)
    moments = list(joined(lake, MOMENTS, DAY))
    assert len(moments) == FRAMES
    assert all(set(captures) == {"a", "b"} for _, captures in moments)
    assert moments[8][1]["b"].earlier_stamp_ns is not None

"""Pictures of a logged video are those that its decoder gives, in whatever order they are asked for."""

import sys
from fractions import Fraction

import cv2
import numpy as np
import pytest

from pipeline.core.errors import MissingExtraError
from pipeline.ingest.messages.video import VideoPictures
from tests.makers import foxglove_logs

av = pytest.importorskip("av")
COUNT, KEY_EVERY = 12, 5


def pictures(width, height):
    """A scene that moves: blurred noise, shifted by two pixels a picture."""
    rng = np.random.default_rng(3)
    scene = cv2.GaussianBlur(rng.integers(0, 255, (height, width + 2 * COUNT, 3), np.uint8), (0, 0), 3)
    return [np.ascontiguousarray(scene[:, 2 * i : 2 * i + width]) for i in range(COUNT)]


def packets(codec, width=96, height=64, **options):
    """Annex B data of one picture each, a key frame every five."""
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.framerate = width, height, "yuv420p", 10
    encoder.time_base, encoder.gop_size, encoder.max_b_frames = Fraction(1, 10), KEY_EVERY, 0
    encoder.options = {"preset": "ultrafast", "tune": "zerolatency"} | options
    data = []
    for i, pixels in enumerate(pictures(width, height)):
        frame = av.VideoFrame.from_ndarray(pixels, format="bgr24")
        frame.pts = i
        data += [bytes(p) for p in encoder.encode(frame)]
    data += [bytes(p) for p in encoder.encode(None)]
    assert len(data) == COUNT
    return data


@pytest.fixture(scope="module")
def streams():
    quiet = {"x265-params": "log-level=none:keyint=5:min-keyint=5:scenecut=0:bframes=0"}
    return {"h264": packets("libx264", sc_threshold="0"), "h265": packets("libx265", **quiet)}


def video(data, name, stamps=None):
    stamps = np.arange(len(data), dtype=np.int64) * 100_000_000 if stamps is None else stamps
    return VideoPictures(lambda i: (name, data[i]), stamps)


@pytest.mark.parametrize("name", ["h264", "h265"])
def test_a_picture_is_the_same_in_whatever_order_it_is_asked_for(streams, name):
    forward = video(streams[name], name)
    seen = [forward.picture(i) for i in range(COUNT)]
    true = np.array(pictures(96, 64), int)
    for i, picture in enumerate(seen):
        loss = np.abs(true - picture).mean(axis=(1, 2, 3))  # against every picture of the scene
        assert (int(loss.argmin()), loss[i] < 6) == (i, True)
    jumping = video(streams[name], name)
    for i in (7, 2, 11, 3, 4, 4, 10):
        np.testing.assert_array_equal(jumping.picture(i), seen[i])


def test_nothing_is_decoded_across_a_missing_picture(streams):
    kept = [i for i in range(COUNT) if i != 2]
    torn = video([streams["h264"][i] for i in kept], "h264", np.array(kept, np.int64) * 100_000_000)
    assert torn.picture(1).shape == (64, 96, 3)
    with pytest.raises(ValueError, match="no video key frame"):
        torn.picture(2)  # it was picture 3
    assert torn.picture(4).shape == (64, 96, 3)  # the next key frame


def test_a_damaged_packet_costs_its_pictures_up_to_the_next_key_frame(streams):
    data = list(streams["h264"])
    data[6] = data[6][: len(data[6]) // 3]
    torn = video(data, "h264")
    for i in (6, 7):
        with pytest.raises(ValueError, match="video"):
            torn.picture(i)
    assert torn.picture(10).shape == (64, 96, 3)


def video_log(kit, data, name, path):
    """A log with the data of a video, one picture a message, in place of its pictures."""
    made, place = kit.Kit(frames=len(data)).drive(), iter(data)

    def as_video(message):
        said = foxglove_logs.foxglove(message)
        if not (message.__msgtype__.endswith("CompressedImage") and message.format == "jpeg"):
            return said
        same = {"timestamp": said.timestamp, "frame_id": said.frame_id}
        return foxglove_logs.schema("CompressedVideo")(**same, data=next(place), format=name)

    return foxglove_logs.write(made, path, as_video)


@pytest.mark.parametrize("name", ["h264", "h265"])
def test_a_log_of_video_gives_frames_from_its_first_key_frame_on(kit, tmp_path, run_ingest, streams, name):
    log = video_log(kit, streams[name][2:], name, tmp_path / "video.mcap")  # it begins between key frames
    result, frames = run_ingest(log)
    assert result.rejected["without_camera_image_damaged"] == KEY_EVERY - 2
    assert {tuple(f.sensors) for f in frames[: KEY_EVERY - 2]} == {("lidar", "radar")}
    frames = frames[KEY_EVERY - 2 :]
    assert len(frames) == COUNT - KEY_EVERY
    seen = video(streams[name], name).picture(KEY_EVERY)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(frames[0].image, np.uint8), 1), seen)


def test_a_day_of_video_without_the_extra_fails_with_what_to_install(
    kit, tmp_path, run_ingest, streams, monkeypatch
):
    log = video_log(kit, streams["h264"], "h264", tmp_path / "video.mcap")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"boresight\[video\]"):
        run_ingest(log)

"""Images pass untouched or become the PNG of their pixels; intrinsics are taken or refused, never made up."""

import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from pipeline.ingest.messages.image import encode_raw_image, inspect_image, label_image, read_camera_info

COLOURS = {"rgb8": [2, 1, 0], "bgr8": [0, 1, 2], "rgba8": [2, 1, 0], "bgra8": [0, 1, 2]}
RNG = np.random.default_rng(0)


def decode(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("encoding", COLOURS)
@pytest.mark.parametrize("step", [None, 301])
def test_raw_colour_images_become_lossless_png(kit, encoding, step):
    pixels = RNG.integers(0, 255, (48, 64, 4 if "a" in encoding else 3), np.uint8)
    image = encode_raw_image(kit.Kit().image(0, pixels, encoding, step))
    assert (image.format, image.width_px, image.height_px) == ("png", 64, 48)
    np.testing.assert_array_equal(decode(image.data), pixels[..., COLOURS[encoding]])


def test_raw_grey_images_keep_their_depth(kit):
    eight, sixteen = RNG.integers(0, 255, (8, 9), np.uint8), RNG.integers(0, 65535, (8, 9), np.uint16)
    np.testing.assert_array_equal(decode(encode_raw_image(kit.Kit().image(0, eight, "mono8")).data), eight)
    message = kit.Kit().image(0, sixteen, "mono16")
    np.testing.assert_array_equal(decode(encode_raw_image(message).data), sixteen)
    message.is_bigendian, message.data = 1, sixteen.astype(">u2").view(np.uint8).reshape(-1)
    np.testing.assert_array_equal(decode(encode_raw_image(message).data), sixteen)


@pytest.mark.parametrize(
    ("pattern", "red"),
    [("bayer_rggb8", (0, 0)), ("bayer_bggr8", (1, 1)), ("bayer_gbrg8", (1, 0)), ("bayer_grbg8", (0, 1))],
)
def test_bayer_patterns_put_red_where_ros_says(kit, pattern, red):
    mosaic = np.zeros((16, 16), np.uint8)
    mosaic[red[0] :: 2, red[1] :: 2] = 200  # a purely red scene
    blue_green_red = decode(encode_raw_image(kit.Kit().image(0, mosaic, pattern)).data)[4:-4, 4:-4]
    assert blue_green_red[..., 2].min() > 150
    assert blue_green_red[..., :2].max() == 0


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_yuv_images_keep_their_brightness(kit, encoding):
    pixels = np.full((4, 8, 2), 128, np.uint8)
    pixels[..., 1 if encoding == "yuv422" else 0] = 180
    grey = decode(encode_raw_image(kit.Kit().image(0, pixels, encoding)).data)
    assert np.ptp(grey) == 0
    assert 180 <= grey.max() <= 195  # video range 16..235


def test_raw_images_that_are_too_short_or_of_unknown_encoding_are_refused(kit):
    message = kit.Kit().image(0, np.zeros((8, 9, 3), np.uint8), "rgb8")
    message.data = message.data[:-1]
    with pytest.raises(ValueError, match="too few"):
        encode_raw_image(message)
    with pytest.raises(ValueError, match="32fc1"):
        encode_raw_image(kit.Kit().image(0, np.zeros((8, 9), np.float32), "32fc1"))


def test_encoded_images_are_known_by_their_own_header():
    pixels = RNG.integers(0, 255, (37, 51, 3), np.uint8)
    for suffix, name in ((".jpg", "jpeg"), (".png", "png")):
        data = cv2.imencode(suffix, pixels)[1].tobytes()
        image = inspect_image(data)
        assert image.data == data
        assert (image.format, image.width_px, image.height_px) == (name, 51, 37)
    assert inspect_image(cv2.imencode(".jpg", pixels)[1].tobytes() + b"\0" * 7).format == "jpeg"


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_no_shortened_image_passes(suffix):
    data = cv2.imencode(suffix, RNG.integers(0, 255, (20, 20, 3), np.uint8))[1].tobytes()
    for length in range(len(data)):
        with pytest.raises((ValueError, IndexError)):
            inspect_image(data[:length])


def test_no_flipped_bit_in_a_png_passes(kit):
    data = kit.label_png(0)
    for byte in range(len(data)):
        flipped = bytearray(data)
        flipped[byte] ^= 1 << (byte % 8)
        with pytest.raises(ValueError, match=r"\w"):
            inspect_image(bytes(flipped))


def test_labels_are_taken_only_from_lossless_grey_images(kit):
    pixels = RNG.integers(0, 19, (6, 7), np.uint8)
    grey = cv2.imencode(".png", pixels)[1].tobytes()
    colour = cv2.imencode(".png", np.dstack([pixels] * 3))[1].tobytes()
    lossy = cv2.imencode(".jpg", pixels)[1].tobytes()
    assert label_image(kit.Kit().compressed(0, grey, "png")) == grey
    np.testing.assert_array_equal(decode(label_image(kit.Kit().image(0, pixels, "mono8"))), pixels)
    np.testing.assert_array_equal(
        decode(label_image(kit.Kit().image(0, pixels.astype("u2"), "16UC1"))), pixels
    )
    for bad in (colour, lossy):
        with pytest.raises(ValueError, match="label images must be"):
            label_image(kit.Kit().compressed(0, bad))
    with pytest.raises(ValueError, match="above 255"):
        label_image(kit.Kit().image(0, pixels.astype("u2") + 300, "16UC1"))


@pytest.mark.parametrize(
    ("spelling", "D", "model", "kept"),
    [
        ("plumb_bob", [0.1, -0.2, 0.01, 0.02, 0.3], "plumb_bob", 5),
        ("radtan", [0.1, -0.2, 0.01, 0.02], "plumb_bob", 4),
        ("rational_polynomial", [0.1] * 8, "rational_polynomial", 8),
        ("rational_polynomial", [0.1] * 8 + [0.0] * 4, "rational_polynomial", 8),
        ("equidistant", [0.1, 0.0, 0.0, 0.0], "equidistant", 4),
        ("fisheye", [0.1, 0.0, 0.0, 0.0], "equidistant", 4),
        ("Kannala_Brandt4", [0.1, 0.0, 0.0, 0.0], "equidistant", 4),
        ("equidistant", [], "equidistant", 0),
        ("", [], "plumb_bob", 0),
    ],
)
@pytest.mark.parametrize("ros", [1, 2])
def test_intrinsics_are_read_in_every_spelling(kit, ros, spelling, D, model, kept):
    camera = read_camera_info(kit.Kit(ros=ros).info(0, model=spelling, D=D))
    assert camera.model == model
    np.testing.assert_array_equal(camera.D, D[:kept])
    assert camera.focal_px == (80.0, 80.0)
    assert (camera.width_px, camera.height_px) == (kit.WIDTH, kit.HEIGHT)


def test_intrinsics_that_say_nothing_are_refused(kit):
    cases = {
        "zero K": kit.Kit().info(0, focal_px=0.0),
        "distortion model": kit.Kit().info(0, model="double_sphere"),
        "is not supported": kit.Kit().info(0, model="rational_polynomial", D=[0.1] * 12),
        "not finite": kit.Kit().info(0, D=[np.nan] * 5),
        "no image size": SimpleNamespace(**{**kit.Kit().info(0).__dict__, "width": 0}),
        "not normalised": kit.Kit().info(0, focal_px=0.8),
        "positive focal": kit.Kit().info(0, focal_px=-3.0),
    }
    for reason, message in cases.items():
        with pytest.raises(ValueError, match=reason):
            read_camera_info(message)


def test_raw_image_and_label_topics_go_through_the_whole_stage(kit, tmp_path, run_ingest):
    drive = kit.Kit().drive()
    pixels = RNG.integers(0, 255, (kit.HEIGHT, kit.WIDTH, 3), np.uint8)
    labels = RNG.integers(0, 19, (kit.HEIGHT // 2, kit.WIDTH // 2), np.uint8)
    for i in range(4):
        stamp = kit.START_NS + i * kit.PERIOD_NS
        drive.replaced(kit.IMAGE, i, drive.image(stamp, np.roll(pixels, i - 1, axis=0), "rgb8"))
        drive.replaced(kit.LABELS, i, drive.image(stamp, labels, "mono8"))
    _, frames = run_ingest(drive.mcap(tmp_path / "a.mcap"))
    assert frames[1].image_format == "png"
    np.testing.assert_array_equal(decode(frames[1].image), pixels[..., ::-1])
    np.testing.assert_array_equal(decode(frames[1].labels_png), labels)


def test_a_header_that_claims_more_pixels_than_a_camera_has_is_refused_before_they_are_decoded():
    jpeg = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    at = jpeg.index(b"\xff\xc0") + 5
    jpeg[at : at + 4] = (32430).to_bytes(2) + (62928).to_bytes(2)
    with pytest.raises(ValueError, match="62928 x 32430 pixels"):
        inspect_image(bytes(jpeg))
    png = bytearray(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes())
    png[16:24] = (100_000).to_bytes(4) * 2
    png[29:33] = zlib.crc32(png[12:29]).to_bytes(4)
    for reads in (inspect_image, lambda data: label_image(SimpleNamespace(format="png", data=data))):
        with pytest.raises(ValueError, match="100000 x 100000 pixels"):
            reads(bytes(png))


@pytest.mark.parametrize("ending", [".webp", ".avif", ".jp2"])
def test_other_codecs_become_the_png_of_their_pixels(ending):
    smooth = cv2.GaussianBlur(RNG.integers(0, 255, (48, 64, 3), np.uint8), (0, 0), 4)
    data = cv2.imencode(ending, smooth)[1].tobytes()
    image = inspect_image(data)
    assert (image.format, image.width_px, image.height_px) == ("png", 64, 48)
    np.testing.assert_array_equal(decode(image.data), cv2.imdecode(np.frombuffer(data, np.uint8), 1))
    assert np.abs(decode(image.data).astype(int) - smooth).mean() < 6
    with pytest.raises(ValueError, match="damaged"):
        inspect_image(data[: len(data) // 4])


def test_nv12_images_have_their_brightness_and_colours_where_they_belong(kit):
    smooth = cv2.GaussianBlur(RNG.integers(0, 255, (48, 64, 3), np.uint8), (0, 0), 6)
    planes = cv2.cvtColor(smooth, cv2.COLOR_BGR2YUV_I420)
    u, v = planes[48:60].reshape(-1), planes[60:].reshape(-1)
    colours = np.stack([u, v], axis=1).reshape(24, 64)  # NV12: both in turn
    message = kit.Kit().image(0, np.vstack([planes[:48], colours]), "nv12", step=70)
    message.height = 48
    image = encode_raw_image(message)
    assert (image.width_px, image.height_px) == (64, 48)
    assert np.abs(decode(image.data).astype(int) - smooth).mean() < 3
    message.data = message.data[: 70 * 50]
    with pytest.raises(ValueError, match="too few"):
        encode_raw_image(message)
    message.height = 47
    with pytest.raises(ValueError, match="even sides"):
        encode_raw_image(message)

"""Images pass untouched or become the PNG of their pixels; intrinsics are taken or refused, never made up."""

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
def test_raw_colour_images_become_lossless_png_and_short_ones_are_refused(kit, encoding, step):
    pixels = RNG.integers(0, 255, (48, 64, 4 if "a" in encoding else 3), np.uint8)
    message = kit.Kit().image(0, pixels, encoding, step)
    image = encode_raw_image(message)
    assert (image.format, image.width_px, image.height_px) == ("png", 64, 48)
    np.testing.assert_array_equal(decode(image.data), pixels[..., COLOURS[encoding]])
    message.data = message.data[: -(step or 1)]
    with pytest.raises(ValueError, match="too few"):
        encode_raw_image(message)


@pytest.mark.parametrize(
    ("encoding", "kind", "is_bigendian"), [("mono8", "u1", 0), ("mono16", "<u2", 0), ("mono16", ">u2", 1)]
)
def test_raw_grey_images_keep_their_depth(kit, encoding, kind, is_bigendian):
    pixels = RNG.integers(0, np.iinfo(kind).max, (8, 9)).astype(kind)
    message = kit.Kit().image(0, pixels.astype(pixels.dtype.newbyteorder("<")), encoding)
    message.is_bigendian, message.data = is_bigendian, pixels.view(np.uint8).reshape(-1)
    np.testing.assert_array_equal(decode(encode_raw_image(message).data), pixels)


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


def test_an_encoding_that_is_none_is_refused_by_name(kit):
    with pytest.raises(ValueError, match="32fc1"):
        encode_raw_image(kit.Kit().image(0, np.zeros((8, 9), np.float32), "32fc1"))


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_yuv_images_keep_their_brightness(kit, encoding):
    pixels = np.full((4, 8, 2), 128, np.uint8)
    pixels[..., 1 if encoding == "yuv422" else 0] = 180
    grey = decode(encode_raw_image(kit.Kit().image(0, pixels, encoding)).data)
    assert np.ptp(grey) == 0
    assert 180 <= grey.max() <= 195  # video range 16..235


@pytest.mark.parametrize(("suffix", "name"), [(".jpg", "jpeg"), (".png", "png")])
def test_encoded_images_are_known_by_their_own_header_and_pass_as_they_are(suffix, name):
    data = cv2.imencode(suffix, RNG.integers(0, 255, (37, 51, 3), np.uint8))[1].tobytes() + b"\0" * 7
    data = data if name == "jpeg" else data[:-7]
    image = inspect_image(data)
    assert (image.data, image.format, image.width_px, image.height_px) == (data, name, 51, 37)


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
    pixels, made = RNG.integers(0, 19, (6, 7), np.uint8), kit.Kit()
    grey = made.compressed(0, cv2.imencode(".png", pixels)[1].tobytes(), "png")
    assert label_image(grey) == bytes(grey.data)
    for raw in (made.image(0, pixels, "mono8"), made.image(0, pixels.astype("u2"), "16UC1")):
        np.testing.assert_array_equal(decode(label_image(raw)), pixels)
    colour = made.compressed(0, cv2.imencode(".png", np.dstack([pixels] * 3))[1].tobytes())
    lossy = made.compressed(0, cv2.imencode(".jpg", pixels)[1].tobytes())
    for bad, reason in (
        (colour, "label images must be"), (lossy, "label images must be"),
        (made.image(0, pixels.astype("u2") + 300, "16UC1"), "above 255"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=reason):
            label_image(bad)


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


@pytest.mark.parametrize(
    ("info", "reason"),
    [
        ({"focal_px": 0.0}, "zero K"),
        ({"model": "double_sphere"}, "distortion model"),
        ({"model": "rational_polynomial", "D": [0.1] * 12}, "is not supported"),
        ({"D": [np.nan] * 5}, "not finite"),
        ({"focal_px": 0.8}, "not normalised"),
        ({"focal_px": -3.0}, "positive focal"),
        ({"width": 0}, "no image size"),
    ],
)
def test_intrinsics_that_say_nothing_are_refused(kit, info, reason):
    size = {"width": info.pop("width")} if "width" in info else {}
    message = SimpleNamespace(**{**kit.Kit().info(0, **info).__dict__, **size})
    with pytest.raises(ValueError, match=reason):
        read_camera_info(message)


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

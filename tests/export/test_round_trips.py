"""What is exported comes back: to 1e-12 everywhere, bit for bit where a format holds the very matrices."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.errors import ConfigError
from pipeline.export.files import prior_text
from pipeline.export.formats import FORMATS, format_named
from pipeline.export.tree import pose_of_rpy, rpy_of
from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import exp_so3
from tests.makers.calibrations import CAMERA, calibration

WRITTEN = [name for name in FORMATS if format_named(name).write is not None]


@pytest.mark.parametrize("name", WRITTEN)
def test_a_calibration_without_a_radar_is_written_and_lacks_it_when_it_comes_back(name):
    sent = calibration()
    alone = calibration(
        pairs={"camera_lidar": sent.pairs["camera_lidar"]}, left_out={"lidar_radar": "held: no guard rails"}
    )
    form = format_named(name)
    files = form.write(alone)
    assert form.pairs(files, alone.names).keys() == {"camera_lidar"}
    if name not in (
        "kitti",
        "nuscenes",
        "t4",
        "opencv",
    ):  # these say it in their side file, or as OpenCV in comments
        assert any(b"lidar_radar is left out" in text for text in files.values())
    with pytest.raises(ConfigError, match="T_lidar_radar"):
        prior_text(form.pairs(files, alone.names), name, ["file"])


@settings(max_examples=300)
@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3))
def test_roll_pitch_yaw_give_the_rotation_back(values):
    R = exp_so3(np.array(values))
    np.testing.assert_allclose(pose_of_rpy(np.zeros(3), rpy_of(R))[:3, :3], R, atol=1e-14)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-7, 1e-5])
def test_roll_pitch_yaw_lose_nothing_where_the_pitch_is_straight_up_or_down(pitch, off):
    R = pose_of_rpy(np.zeros(3), np.array([0.7, pitch + off, -1.1]))[:3, :3]
    np.testing.assert_allclose(pose_of_rpy(np.zeros(3), rpy_of(R))[:3, :3], R, atol=1e-14)


@pytest.mark.parametrize("name", WRITTEN)
def test_warnings_frames_and_sigma_are_in_the_file_or_beside_it(name, tmp_path):
    from pipeline.export.files import written_files

    sent = calibration()
    pair = sent.pairs["lidar_radar"]
    held = replace(
        pair, status="held", reason="roll -- halves\ndisagree", observable=(True,) * 5 + (False,), certified=(),
    )  # fmt: skip
    whole = replace(sent.pairs["camera_lidar"], reason="since it moved")  # no warning: all of it is certified
    pairs = sent.pairs | {"camera_lidar": whole, "lidar_radar": held}
    files = written_files(format_named(name), calibration(pairs=pairs), tmp_path / "o")
    text = b"".join(files.values()).decode(errors="replace")
    at_prior = "certified: nothing; at the prior: up"
    for words in ("lidar_radar is HELD", at_prior, "optical: x right, y down, z forward"):
        assert words in text
    assert "camera_lidar: since it moved" not in text
    side = [path for path in files if path.name.endswith(".provenance.json")]
    assert bool(side) != format_named(name).holds_provenance
    if side:
        said = json.loads(files[side[0]])
        assert said["pairs"]["lidar_radar"]["sigma"]["rx_rad"] == pytest.approx(1e-3)
        assert said["pairs"]["lidar_radar"]["kept_at_prior"] == ["tz"]


@pytest.mark.parametrize(
    ("name", "D", "model"),
    [("kalibr", [0.1, 0.2, 0, 0, 0.3], "plumb_bob"), ("kalibr", [0.0] * 7 + [0.1], "rational_polynomial")],
)
def test_a_lens_that_a_format_does_not_know_is_refused_and_not_cut_short(name, D, model):
    lens = Camera(model, CAMERA.K, np.array(D), 1280, 720)
    with pytest.raises(ConfigError, match="distortion"):
        format_named(name).write(calibration(cameras={"camera": lens}))


@pytest.mark.parametrize("D", [[], [0.1, 0.01, -0.02, 0.003]])
def test_a_fisheye_is_written_as_one(D):
    lens = calibration(cameras={"camera": Camera("equidistant", CAMERA.K, np.array(D), 1280, 720)})
    assert b"distortion_model: equidistant" in format_named("kalibr").write(lens)["camchain.yaml"]


@pytest.mark.parametrize("name", ["kitti", "nuscenes", "t4", "kalibr"])
def test_formats_that_need_intrinsics_say_so(name):
    with pytest.raises(ConfigError, match="camera: the format needs intrinsics"):
        format_named(name).write(calibration(cameras={}))


def test_numbers_keep_their_digits_in_yaml_whatever_reader_meets_them():
    import yaml

    from pipeline.export.texts import load_yaml, to_json, to_yaml

    assert json.loads(to_json({"a": [1.5, float("nan")]})) == {"a": [1.5, None]}  # JSON has no word for it
    values = [1e-17, 1e22, 0.1 + 0.2, -1.5e-300, 3.0]
    text = to_yaml({"values": values}, ["a comment: with - signs"])
    assert load_yaml("f", text)["values"] == values
    assert yaml.safe_load(text)["values"] == values  # YAML 1.1 takes 1e-17 for a word

"""Files of other programs as the prior of a whole rig: each sensor by its name, and what is missing or twice named."""

import json
import re

import numpy as np
import pytest

from pipeline.core.config import load_fleet
from pipeline.export.calibration import ExportedCalibration, ExportedPair, FrameNames
from pipeline.export.files import write_files, written_files
from pipeline.export.formats import FORMATS, format_named
from pipeline.rig.day_prior import read_star
from pipeline.rig.graph import Sensor, tie, words_of
from pipeline.rig.se3 import inverse
from tests.audit.test_many_sensors import RIGS
from tests.makers.calibrations import CAMERA, random_transform
from tests.makers.commands import command

TOP = Sensor("top", "lidar")
OTHERS = (
    Sensor("front", "camera"), Sensor("left", "camera"), Sensor("side", "lidar"),
    Sensor("bumper", "radar"), Sensor("corner", "radar"),
)  # fmt: skip
ANOTHER_LIDAR = '[rigs.van]\nreference = "top"\n[rigs.van.lidars.side]\npoints = "/side"\n[rigs.van.prior]'
FLEET = RIGS.replace("[rigs.van.prior]", ANOTHER_LIDAR)
T_TOP = dict(
    zip((s.name for s in OTHERS), (random_transform(np.random.default_rng(k)) for k in range(5)), strict=True)
)
NAMES = {"front": "cam_front_optical", "corner": "ars548_fl", "side": "lidar_right"}


def exported(folder, form, sensors=OTHERS):
    ties = {s: tie(s, TOP) for s in OTHERS}
    pairs = {}
    for sensor, edge in ((s, ties[s]) for s in sensors):
        T = T_TOP[sensor.name] if edge.parent == TOP else inverse(T_TOP[sensor.name])
        pairs[words_of(edge)] = ExportedPair(edge, T)
    calibration = ExportedCalibration(
        "van-1", "record", "joint", "0.11.0", pairs, tuple(ties.values()), FrameNames(NAMES),
        cameras={"front": CAMERA, "left": CAMERA},
    )  # fmt: skip
    files = written_files(format_named(form), calibration, folder / form)
    write_files(files)
    return [str(f) for f in files]


@pytest.fixture
def fleet(tmp_path):
    (tmp_path / "fleet.toml").write_text(FLEET)
    return tmp_path / "fleet.toml"


def imported(capsys, form, files, fleet, out, *more):
    told = command(capsys, "import", form, *files, "--fleet", fleet, "--out", out, *more)
    return told.code, told.summary


@pytest.mark.parametrize("form", [f for f in FORMATS if format_named(f).write is not None])
def test_every_format_comes_back_as_the_prior_of_all_sensors(form, fleet, tmp_path, capsys):
    aside = (".xacro", "_intrinsics.yaml") if form != "xacro" else ("launch.py",)
    files = [f for f in exported(tmp_path, form) if not f.endswith((*aside, "launch.py"))]
    # A log has no side file that says what its frames are called.
    names = (
        [word for n, f in NAMES.items() for word in ("--frame", f"{n}={f}")] if form == "tf-static" else []
    )
    code, summary = imported(capsys, form, files, fleet, tmp_path / "prior.json", *names)
    assert (code, summary.get("sensors", summary)) == (0, ["front", "left", "side", "bumper", "corner"])
    star = read_star(tmp_path / "prior.json", load_fleet(fleet).rigs["van"])
    for name, T in T_TOP.items():
        np.testing.assert_allclose(star["top", name], T, atol=1e-9)


@pytest.mark.parametrize("form", ["urdf", "kalibr", "kitti", "opencv", "nuscenes"])
def test_a_sensor_that_the_files_lack_is_named_and_taken_from_another_prior_where_one_is_given(
    form, fleet, tmp_path, capsys
):
    files = exported(tmp_path, form, [s for s in OTHERS if s.name not in ("left", "corner")])
    code, summary = imported(
        capsys, form, files, fleet, tmp_path / "prior.json", "--frame", "corner=ars548_fl"
    )
    assert code == 2
    assert "missing: left, corner (frame ars548_fl)" in summary["reason"]
    assert form in summary["reason"]
    assert not (tmp_path / "prior.json").exists()
    T = {n: np.eye(4).tolist() for n in T_TOP}
    (tmp_path / "old.json").write_text(json.dumps({"reference": "top", "T": T}))
    out = tmp_path / "prior.json"
    assert imported(capsys, form, files, fleet, out, "--also", tmp_path / "old.json")[0] == 0
    star = read_star(out, load_fleet(fleet).rigs["van"])
    np.testing.assert_array_equal(star["top", "corner"], np.eye(4))
    np.testing.assert_allclose(star["top", "side"], T_TOP["side"], atol=1e-9)


def test_a_sensor_that_stands_twice_or_in_a_chain_without_its_name_is_named(fleet, tmp_path, capsys):
    [first, *_], other = exported(tmp_path, "urdf"), tmp_path / "other.urdf"
    text = (tmp_path / "urdf" / "sensors.urdf").read_text()
    other.write_text(re.sub(r'xyz="[^"]*"', 'xyz="0 0 0"', text, count=1))
    code, summary = imported(capsys, "urdf", [first, str(other)], fleet, tmp_path / "prior.json")
    assert code == 2
    assert "cam_front_optical: occurs twice" in summary["reason"]
    assert str(other) in summary["reason"]
    chain = tmp_path / "kalibr" / "camchain.yaml"
    exported(tmp_path, "kalibr")
    chain.write_text(chain.read_text().replace("/left/image_raw", "/cam_front_optical/image_raw"))
    code, summary = imported(capsys, "kalibr", [str(chain)], fleet, tmp_path / "prior.json")
    assert code == 2
    assert "a sensor occurs twice" in summary["reason"]
    # Topics that name no camera are not guessed at.
    exported(tmp_path, "kalibr", [s for s in OTHERS if s.name != "left"])
    chain.write_text(chain.read_text().replace("/cam_front_optical/image_raw", "/cam0/image_raw"))
    code, summary = imported(capsys, "kalibr", [str(chain)], fleet, tmp_path / "prior.json")
    assert code == 2
    assert "use these topics" in summary["reason"]


def test_a_rig_is_named_where_the_fleet_has_several(fleet, tmp_path, capsys):
    fleet.write_text(
        FLEET + FLEET[FLEET.index("[rigs.van]") : FLEET.index("[vehicles")].replace("van", "bus")
    )
    files = exported(tmp_path, "opencv")
    code, summary = imported(capsys, "opencv", files, fleet, tmp_path / "prior.json")
    assert code == 2
    assert "name one of van, bus with --rig" in summary["reason"]
    assert imported(capsys, "opencv", files, fleet, tmp_path / "prior.json", "--rig", "bus")[0] == 0

"""A drive as Foxglove MCAP: read by the official schemas and by our own ingest it says what the lake says."""

import sys

import numpy as np
import pytest

from pipeline.rig.cameras import Camera
from pipeline.rig.graph import pose_columns
from pipeline.rig.se3 import exp_se3, inverse
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of
from schemas.calibrations import CALIBRATIONS
from tests.makers.calibrations import SIGMA, T_CAMERA_LIDAR, T_LIDAR_RADAR
from tests.makers.commands import command
from tests.makers.foxglove_logs import messages_of
from tests.makers.lakes import write_frames, write_observations
from tests.makers.stages import ingest_day
from tests.makers.table_rows import make_frame, make_observation, make_row
from tests.makers.written_logs import fleet_config, jpeg

pytest.importorskip("foxglove")
DAY, COUNT = Partition("car", "2026-03-02"), 4
TOPICS = {
    "image": "/camera/image", "camera": "/camera/calibration", "boxes": "/camera/boxes",
    "overlay": "/camera/overlay", "overlay_prior": "/camera/overlay_prior", "lidar": "/lidar/points",
    "lidar_prior": "/lidar/points_prior", "clusters": "/lidar/boxes", "radar": "/radar/points",
    "radar_prior": "/radar/points_prior", "tf": "/tf", "table": "/boresight/calibration",
}  # fmt: skip
START_NS = 1_772_400_000_000_000_000
CAMERA = Camera("equidistant", np.array([[40.0, 0, 48], [0, 40, 32], [0, 0, 1]]), np.zeros(0), 96, 64)
TURN = exp_se3(np.array([0.01, -0.02, 0.03, 0.04, 0.05, -0.06]))  # from the prior to the calibration
T = {"camera_lidar": T_CAMERA_LIDAR, "lidar_radar": T_LIDAR_RADAR}
# What a viewer needs beside clouds of a size that ingest takes.
INTRINSICS = {
    "image_format": "jpeg", "image_width_px": 96, "image_height_px": 64, "camera_model": CAMERA.model,
    "camera_K": CAMERA.K, "camera_D": CAMERA.D,
}  # fmt: skip


def frame(i):
    rng, stamp = np.random.default_rng(i), START_NS + i * 100_000_000
    stamps = {"stamp_ns": stamp, "lidar_stamp_ns": stamp, "camera_stamp_ns": stamp + 10**6,
              "radar_stamp_ns": stamp - 10**6}  # fmt: skip
    xyz = rng.uniform((3, -9, -2), (40, 9, 3), (600, 3)).astype(np.float32)
    clouds = {f"lidar_{n}_m": xyz[:, k] for k, n in enumerate("xyz")}
    clouds |= {"lidar_intensity": xyz[:, 0], "lidar_ring": None, "lidar_time_s": None}
    return make_frame(rng, frame_index=i, drive=0, image=jpeg(i), **stamps, **INTRINSICS, **clouds)


def observation(i):
    rng = np.random.default_rng(50 + i)
    same = {k: v for k, v in INTRINSICS.items() if k != "image_format"}
    boxes = {"road_user_boxes_px": np.array([[10, 20, 30, 40]], np.float32), "road_user_classes": ["car"],
             "road_user_scores": np.ones(1, np.float32)}  # fmt: skip
    edges = rng.uniform((5, -3, -1), (30, 3, 2), (7, 3)).astype(np.float32)
    return make_observation(rng, frame_index=i, **same, **boxes, lidar_edge_xyz_m=edges)


def records():
    rng, found = np.random.default_rng(0), []
    for pair, pose in (T | {"camera_radar": T_CAMERA_LIDAR @ T_LIDAR_RADAR}).items():
        parent, child = pair.split("_")
        said = {"vehicle": "car", "day": DAY.day, "method": "joint", "pair": pair, "status": "accepted", "reason": "",
                "parent_frame": parent, "child_frame": child, "determined": ["azimuth", "elevation"],
                "observable": [True] * 5 + [False], "covariance": np.diag(SIGMA**2), "work_key": pair}  # fmt: skip
        prior = pose_columns(inverse(TURN) @ pose, "prior_")
        found.append(make_row("calibrations", rng, **said, **pose_columns(pose), **prior))
    return found


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """A day of four frames, the third of which perception left out."""
    lake = Lake.at(tmp_path_factory.mktemp("drive") / "lake")
    write_frames(lake, DAY, [frame(i) for i in range(COUNT)], "key")
    write_observations(lake, DAY, [observation(i) for i in range(COUNT) if i != 2], "key")
    commit_records(lake, CALIBRATIONS, records())
    return lake


def export(capsys, lake, out, day=DAY.day, *more):
    call = ("export", "foxglove", "--lake", lake.root, "--vehicle", "car", "--day", day, "--out", out, *more)
    return command(capsys, *call)


@pytest.fixture
def drive(lake, capsys):
    """The day exported, once."""
    out = lake.root.parent / "drive.mcap"
    if not out.exists():
        assert export(capsys, lake, out).code == 0
    return out


@pytest.fixture
def messages(drive):
    return messages_of(drive)


def test_every_topic_has_its_messages_and_images_pass_byte_for_byte(messages):
    without = 1  # the frame that perception left out
    counts = dict.fromkeys(TOPICS.values(), COUNT)
    counts |= {TOPICS[n]: COUNT - without for n in ("boxes", "overlay", "overlay_prior", "clusters")}
    counts[TOPICS["table"]] = 1
    assert {topic: len(found) for topic, found in messages.items()} == counts
    assert [m.data for m in messages[TOPICS["image"]]] == [jpeg(i) for i in range(COUNT)]
    assert {m.frame_id for m in messages[TOPICS["image"]]} == {"camera"}


def test_fewer_frames_are_spread_over_the_day(lake, tmp_path, capsys):
    export(capsys, lake, tmp_path / "few.mcap", DAY.day, "--most-frames", 2)
    images = messages_of(tmp_path / "few.mcap")[TOPICS["image"]]
    assert [m.data for m in images] == [jpeg(0), jpeg(COUNT - 1)]


def test_the_camera_is_called_what_foxglove_calls_it(messages):
    camera = messages[TOPICS["camera"]][0]
    assert (camera.distortion_model, camera.width, camera.height) == ("kannala_brandt", 96, 64)
    assert (list(camera.K), list(camera.D)) == (CAMERA.K.reshape(-1).tolist(), [0.0] * 4)
    assert np.array(camera.P).reshape(3, 4)[:, :3].tolist() == CAMERA.K.tolist()


def test_boxes_of_road_users_are_where_the_detector_saw_them(messages):
    boxes = messages[TOPICS["boxes"]][0]
    corners = [(10.5, 20.5), (30.5, 20.5), (30.5, 40.5), (10.5, 40.5)]
    assert [(p.x, p.y) for p in boxes.points[0].points] == corners
    assert boxes.texts[0].text == "car"


def test_the_table_says_change_and_sigma_of_each_axis(messages):
    [table] = messages[TOPICS["table"]]
    rows = {(r["pair"], r["axis"]): r for r in table["rows"]}
    assert len(rows) == 18
    row = rows["camera_lidar", "rz"]
    assert (row["change"], row["unit"]) == (pytest.approx(np.degrees(0.03), abs=1e-9), "deg")
    assert row["sigma"] == pytest.approx(np.degrees(SIGMA[2]))
    assert [rows["camera_lidar", axis]["determined"] for axis in ("ty", "tz")] == [True, False]
    axes = "used: pitch, yaw, roll, right, down; certified: azimuth, elevation; at the prior: forward"
    assert f"camera_lidar: {axes}" in table["in_words"]


def test_our_own_ingest_reads_the_drive_back(lake, drive, tmp_path):
    topics = {"camera": {"image": TOPICS["image"], "info": TOPICS["camera"],
                         "semantics": {"source": "onnx", "segmenter": "s.toml", "detector": "d.toml"}},
              "lidar": {"points": TOPICS["lidar"]}, "prior": {"topic": TOPICS["tf"]},
              "radar": {"points": TOPICS["radar"], "doppler_field": "range_rate_mps"}}  # fmt: skip
    plain = fleet_config().model_dump(mode="json", exclude_none=True) | {"rigs": {"default": topics}}
    fleet = type(fleet_config()).model_validate(plain).read_from(tmp_path / "fleet.toml")
    again = Lake.at(tmp_path / "lake")
    assert ingest_day([drive], DAY, fleet, again).status == "done"
    before, after = (list(frames_of(its, DAY)) for its in (lake, again))
    for a, b in zip(before, after, strict=True):
        for name in ("image", "camera_stamp_ns", "radar_stamp_ns"):
            assert getattr(a, name) == getattr(b, name)
        np.testing.assert_array_equal(a.lidar_xyz_m, b.lidar_xyz_m)
        np.testing.assert_array_equal(a.radar_range_rate_mps, b.radar_range_rate_mps)
        np.testing.assert_allclose(b.priors["camera_lidar"], T_CAMERA_LIDAR, atol=1e-12)


def test_what_cannot_be_shown_and_an_extra_that_is_missing_are_usage_errors(
    lake, tmp_path, capsys, monkeypatch
):
    assert export(capsys, lake, tmp_path / "a.mcap", "2026-03-09").code == 2
    told = export(capsys, lake, tmp_path)
    assert told.code == 2
    assert "must end in .mcap" in told.err
    monkeypatch.setitem(sys.modules, "foxglove", None)
    told = export(capsys, lake, tmp_path / "a.mcap")
    assert told.code == 2
    assert "pip install 'boresight[viz]'" in told.err
    assert not (tmp_path / "a.mcap").exists()

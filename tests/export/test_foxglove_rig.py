"""The drive of a rig of many sensors: channels for every sensor, in frames that hang where the calibration has them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.rig.se3 import from_quaternion, inverse, transform_points
from pipeline.store.commits import commit_records
from pipeline.store.current import transform_of
from pipeline.store.moments import write_moments
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS
from schemas.moments import MOMENTS, PERCEIVED
from tests.export.test_foxglove import CAMERA, frame, observation
from tests.makers.commands import command
from tests.makers.foxglove_logs import messages_of
from tests.makers.lakes import joined_of
from tests.makers.rig_records import T_TOP, rig_records

pytest.importorskip("foxglove")
DAY, COUNT = Partition("van", "2026-03-01"), 3
# By sensor, the kind of the row that it has, and whose of another day.
SENSORS = {
    "front": ("camera", 0), "left": ("camera", 10), "top": ("lidar", 0), "bumper": ("radar", 0),
    "corner": ("radar", 10),
}  # fmt: skip
RECORDS = rig_records("van", 1, np.random.default_rng(4))
AROUND = np.random.default_rng(7).uniform((-30, -30, -1), (30, 30, 2), (60, 3)).astype(np.float32)


def write(lake, table, made):
    with write_moments(lake, table, DAY, "key") as writer:
        for k in range(COUNT):
            moment, _ = joined_of(made(k))
            rows = {
                name: replace(joined_of(made(k + more))[1][kind], moment=k)
                for name, (kind, more) in SENSORS.items()
            }
            if table is PERCEIVED:
                side = np.resize(rows["top"].lidar_edge_side, len(AROUND))
                rows["top"] = replace(rows["top"], lidar_edge_xyz_m=AROUND, lidar_edge_side=side)
            writer.append(moment, rows)
        writer.describe(kept={"frames": COUNT}, rejected={})


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    lake = Lake.at(tmp_path_factory.mktemp("rig") / "lake")
    write(lake, MOMENTS, frame)
    write(lake, PERCEIVED, observation)
    held = {"status": "held", "reason": "too few frames"}
    commit_records(
        lake, CALIBRATIONS, [replace(r, **held) if r.child_frame == "corner" else r for r in RECORDS]
    )
    return lake.root


def of_day(parent, child):
    """T_parent_child of the day's record."""
    [found] = [transform_of(r) for r in RECORDS if (r.parent_frame, r.child_frame) == (parent, child)]
    return found


def exported(capsys, lake, out, *more):
    call = ["export", "foxglove", "--lake", lake, "--vehicle", "van", "--day", DAY.day, "--out", out, *more]
    told = command(capsys, *call)
    return told, messages_of(out) if out.exists() else {}


def poses(message):
    by_child = {}
    for t in message.transforms:
        q, p = t.rotation, t.translation
        T = from_quaternion(np.array([q.w, q.x, q.y, q.z]), np.array([p.x, p.y, p.z]))
        by_child[t.child_frame_id] = (t.parent_frame_id, T)
    return by_child


def test_every_sensor_has_channels_of_its_own(lake, tmp_path, capsys):
    told, found = exported(capsys, lake, tmp_path / "drive.mcap")
    assert told.code == 3  # the corner's edge is held
    of_camera = ("image", "calibration", "boxes", "overlay", "overlay_prior")
    wanted = {f"/{c}/{topic}" for c in ("front", "left") for topic in of_camera}
    wanted |= {"/top/boxes", "/tf", "/boresight/calibration"}
    wanted |= {f"/{r}/{topic}" for r in ("top", "bumper", "corner") for topic in ("points", "points_prior")}
    assert found.keys() == wanted
    assert {len(own) for topic, own in found.items() if topic != "/boresight/calibration"} == {COUNT}
    for k in range(COUNT):
        assert found["/front/image"][k].data == frame(k).image
        assert found["/left/image"][k].data == frame(k + 10).image
        x = frame(k + 10).radar_x_m
        points = np.frombuffer(found["/corner/points"][k].data, "<f4").reshape(len(x), -1)
        np.testing.assert_array_equal(points[:, 0], x)
        assert found["/corner/points"][k].frame_id == "corner"
    layout = json.loads((tmp_path / "drive.layout.json").read_text())
    assert "/left/overlay" in json.dumps(layout)


def test_frames_hang_where_the_day_and_the_prior_have_them(lake, tmp_path, capsys):
    _, found = exported(capsys, lake, tmp_path / "drive.mcap")
    tree = poses(found["/tf"][0])
    # The corner is held.
    assert tree.keys() == {"front", "left", "bumper", "top_prior", "bumper_prior", "corner_prior"}
    assert {parent for child, (parent, _) in tree.items() if child != "top_prior"} == {"top"}
    assert tree["top_prior"][0] == "front"
    np.testing.assert_allclose(tree["top_prior"][1], inverse(T_TOP["front"]), atol=1e-9)
    for name in ("bumper", "corner"):
        np.testing.assert_allclose(tree[f"{name}_prior"][1], T_TOP[name], atol=1e-9)
    np.testing.assert_allclose(tree["bumper"][1], of_day("top", "bumper"), atol=1e-9)
    np.testing.assert_allclose(tree["front"][1], inverse(of_day("front", "top")), atol=1e-9)


def test_the_reference_lidar_s_edges_lie_in_every_camera_s_image(lake, tmp_path, capsys):
    _, found = exported(capsys, lake, tmp_path / "drive.mcap")
    for name in ("front", "left"):
        for topic, T in (("overlay", of_day(name, "top")), ("overlay_prior", inverse(T_TOP[name]))):
            uv, valid = CAMERA.project(transform_points(T, AROUND.astype(float)))
            wanted = uv[valid & CAMERA.contains(uv)] + 0.5
            assert len(wanted) > 3
            [drawn] = found[f"/{name}/{topic}"][1].points
            np.testing.assert_allclose([[p.x, p.y] for p in drawn.points], wanted, atol=1e-6)


def test_only_the_sensors_that_are_named_are_shown_and_an_unknown_one_is_refused(lake, tmp_path, capsys):
    _, found = exported(capsys, lake, tmp_path / "drive.mcap", "--sensor", "left", "--sensor", "corner")
    topics = {topic.split("/")[1] for topic in found}
    assert topics == {"left", "corner", "tf", "boresight"}
    told, found = exported(capsys, lake, tmp_path / "other.mcap", "--sensor", "rear")
    assert (told.code, found) == (2, {})
    assert "no rear: the rig has front, left, top, bumper, corner" in told.out

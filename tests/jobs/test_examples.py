"""Examples run as they stand, and what they draw is what the lake says."""

import runpy
from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import log_so3, transform_points
from pipeline.store.commits import commit_records
from pipeline.store.current import prior_of, transform_of
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS
from tests.audit.fleet_records import vehicle_records
from tests.conftest import REPO
from tests.makers.lakes import write_frames
from tests.makers.table_rows import make_frame

DAYS, HELD = 12, (3, 11)
CAMERA = Camera("plumb_bob", np.array([[200.0, 0, 160], [0, 200, 100], [0, 0, 1]]), np.zeros(5), 320, 200)


def frame(rng):
    """A grey picture and points spread in front of the camera, so far apart that dots do not hide each other."""
    grey = cv2.imencode(".png", np.full((200, 320, 3), 96, np.uint8))[1].tobytes()
    y, z = (g.ravel() for g in np.meshgrid(np.arange(-7, 8, 1.0), np.arange(-4, 4, 1.0)))
    points = {"lidar_x_m": np.full_like(y, 12.0), "lidar_y_m": y, "lidar_z_m": z}
    picture = {"image": grey, "image_format": "png", "image_width_px": 320, "image_height_px": 200}
    camera = {"camera_model": CAMERA.model, "camera_K": CAMERA.K, "camera_D": CAMERA.D}
    return make_frame(rng, **picture, **camera, **{k: v.astype(np.float32) for k, v in points.items()})


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """Names that the example leaves, the vehicle's current records, and where the pictures are."""
    folder, rng = tmp_path_factory.mktemp("example"), np.random.default_rng(5)
    lake = Lake.at(folder / "lake")
    records = vehicle_records("v", DAYS, rng, status=lambda day: "held" if day in HELD else "accepted")
    earlier = [
        replace(r, tx_m=r.tx_m + 9.0, work_key=f"old {r.work_key}") for r in records[:3]
    ]  # solved again since
    commit_records(lake, CALIBRATIONS, earlier)
    commit_records(lake, CALIBRATIONS, records)
    last = max(r.day for r in records if r.status == "accepted")
    write_frames(lake, Partition("v", last), [frame(rng), frame(rng)], "key")
    script = REPO / "jobs" / "examples" / "read_a_lake.py"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", [str(script), str(folder / "lake"), "v", str(folder / "pictures")])
        names = runpy.run_path(str(script))
    return names, [r for r in records if r.pair == "camera_lidar"], folder / "pictures"


def test_the_history_is_that_of_the_current_records_with_their_sigmas(ran):
    names, records, _ = ran
    T = [transform_of(r) for r in records]
    turn = [np.degrees(log_so3(t[:3, :3] @ T[0][:3, :3].T)) for t in T]
    shift = [100 * (t[:3, 3] - T[0][:3, 3]) for t in T]
    np.testing.assert_allclose(names["change"], np.hstack([turn, shift]), atol=1e-9)
    assert names["is_accepted"].tolist() == [i not in HELD for i in range(DAYS)]
    np.testing.assert_allclose(names["sigma"][0, :3], np.degrees(np.sqrt(np.diag(records[0].covariance)[:3])))


def test_the_history_is_drawn(ran):
    picture = cv2.imread(str(ran[2] / "history.png"))
    assert picture.shape == (660, 1320, 3)
    blue = np.all(np.abs(picture.astype(int) - (180, 119, 31)) < 8, axis=2)  # tab:blue, the accepted days
    orange = np.all(np.abs(picture.astype(int) - (14, 127, 255)) < 8, axis=2)
    assert blue.sum() > 1000
    assert 20 < orange.sum() < blue.sum()
    assert len(ran[0]["figure"].axes) == 6


def test_the_overlay_has_a_dot_where_prior_and_record_put_each_point(ran):
    names, records, folder = ran
    record = [r for r in records if r.status == "accepted"][-1]
    picture = cv2.imread(str(folder / "overlay.png"))
    seen = 0
    for T, is_left in ((prior_of(record), True), (transform_of(record), False)):
        uv, valid = CAMERA.project(transform_points(T, names["points_lidar"]))
        inside = valid & CAMERA.contains(uv, margin_px=3.0) & ((uv[:, 0] < 160) == is_left)
        for u, v in np.round(uv[inside & (np.abs(uv[:, 0] - 160) > 5)]).astype(int):
            assert np.ptp(picture[v, u].astype(int)) > 60, (u, v)  # a colour, where the picture is grey
            seen += 1
    assert seen > 60
    is_dot = np.ptp(picture.astype(int), axis=2) > 60
    assert is_dot.mean() < 0.1

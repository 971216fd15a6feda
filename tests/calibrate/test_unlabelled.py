"""A camera without semantics: what is left out says why, and what is calibrated says how."""

import cv2
import numpy as np
import pytest

from pipeline.calibrate.day import unlabelled_pairs
from pipeline.calibrate.records import notes_of_pair
from pipeline.calibrate.select.triggers import trigger_metrics
from pipeline.calibrate.stage import noted
from schemas.faults import FAULTS
from schemas.observations import STEP_RIGHT, WITHOUT_LABELS
from tests.calibrate.test_calibrate_day import DAY, fleet_of, lake_with, records_of
from tests.makers.solve_scenes import LABEL_SCALE, TRUTH, make_day
from tests.makers.stages import calibrate_day
from tests.makers.table_rows import make_row

RNG = np.random.default_rng(0)
NOBODY = {"road_user_boxes_px": np.zeros((0, 4), np.float32), "road_user_classes": [],
          "road_user_scores": np.zeros(0, np.float32)}  # fmt: skip


def png(image):
    return cv2.imencode(".png", image)[1].tobytes()


@pytest.fixture(scope="module")
def day():
    size = (round(320 * LABEL_SCALE), round(640 * LABEL_SCALE))
    steps = np.zeros(size, np.uint8)
    steps[:, 100] = STEP_RIGHT
    return make_day(20, labels_png=png(np.full(size, 255, np.uint8)), steps_png=png(steps), **NOBODY)


def test_pairs_that_need_labels_or_road_users_are_refused_and_say_so(day):
    alone = unlabelled_pairs(day, {"camera": "front"}, needs_labels=False)
    assert set(alone) == {"camera_radar"}
    assert set(unlabelled_pairs(day, {}, needs_labels=True)) == {"camera_lidar", "camera_radar"}
    assert alone["camera_radar"].fault == "no_labels"
    assert alone["camera_radar"].reason.startswith(f"{FAULTS['no_labels']}, front: camera-radar needs boxes")
    assert unlabelled_pairs(make_day(2), {}, needs_labels=True) == {}


def test_the_note_names_what_does_not_check_the_pose(day):
    how, unchecked = notes_of_pair("camera_lidar", day)
    assert how == WITHOUT_LABELS
    assert "boxes" in unchecked
    assert notes_of_pair("lidar_radar", day) == notes_of_pair("camera_lidar", make_day(2)) == []


def test_poses_of_the_camera_have_the_note_and_those_of_others_do_not():
    record = make_row(
        "calibrations", RNG, pair="camera_lidar", parent_frame="front", child_frame="top",
        notes=[WITHOUT_LABELS],
    )  # fmt: skip
    kinds = {"front": "camera", "left": "camera", "top": "lidar"}
    poses = [make_row("poses", RNG, sensor=s, kind=k, reference="top", notes=[]) for s, k in kinds.items()]
    assert [row.notes for row in noted(poses, [record])] == [[WITHOUT_LABELS], [], []]


@pytest.mark.parametrize("method", ["tracking", "joint-optimisation"])
def test_other_methods_are_refused_for_lack_of_labels(day, tmp_path, method):
    lake = lake_with(tmp_path, day)
    calibrate_day(DAY, fleet_of(), lake, method=method)
    found = {r.pair: r for r in records_of(lake)}
    for pair in ("camera_lidar", "camera_radar"):
        assert (found[pair].status, found[pair].faults) == ("refused", ["no_labels"])


def test_triggers_are_not_measured_against_labels_that_are_not_there(day):
    found = trigger_metrics(day[:3], TRUTH)
    assert found["camera_lidar"] == found["camera_radar"] == {}
    assert found["lidar_radar"]

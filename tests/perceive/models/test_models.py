"""Models behind manifests: heads, letterboxes, alignment of logits, and errors that name manifest and key."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.core.config import load_fleet
from pipeline.core.errors import ModelError, ModelOutputError
from pipeline.perceive.models.detector import Detector, decode_head
from pipeline.perceive.models.manifest import load_manifest
from pipeline.perceive.models.source import Segmenter
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from tests.makers.lakes import write_frames
from tests.makers.onnx_models import save_constant, save_segmenter, write_manifest
from tests.makers.stages import perceive_day

COLOURS = [[0.2, 0.2, 0.2], [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]]  # RGB of ADE20K wall, building, sky
DAY = Partition("car-1", "2026-03-02")
FITS = ("letterbox_top_left", "letterbox_centre", "stretch")


PICTURE = np.zeros((96, 160, 3), np.uint8)


def manifest_of(folder, task, given, output, name="m"):
    file = write_manifest(folder / f"{name}.toml", folder / f"{name}.onnx", task, given, output)
    return load_manifest(file, task)


def segmenter(folder, fit="stretch", stride=4):
    save_segmenter(folder / "seg.onnx", (96, 160), stride, COLOURS)
    given = {"size": [96, 160], "scale": 1 / 255, "fit": fit, "pad": 128.0}
    return manifest_of(folder, "segment", given, {"layout": "logits", "label_set": "ade20k"}, "seg")


def answering(folder, answer, layout, label_set="cityscapes"):
    """A segmenter that gives this answer to every picture."""
    save_constant(folder / "m.onnx", answer)
    given = {"size": [96, 160], "fit": "stretch"}
    return Segmenter(manifest_of(folder, "segment", given, {"layout": layout, "label_set": label_set}))


def detector(folder, answer, layout, label_set="road_users", **given):
    save_constant(folder / "det.onnx", answer)
    given = {"size": [96, 160], "fit": "letterbox_top_left"} | given
    return Detector(manifest_of(folder, "detect", given, {"layout": layout, "label_set": label_set}, "det"))


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("shape", [(192, 320), (200, 320), (96, 400), (300, 310)])
def test_boundaries_of_reduced_logits_lie_where_the_image_has_them(tmp_path, fit, shape):
    rows, columns = shape
    image = np.full((rows, columns, 3), 51, np.uint8)
    image[:, columns // 3 :] = (230, 26, 26)  # BGR: sky
    image[: rows // 4] = (26, 26, 230)  # building
    [labels] = Segmenter(segmenter(tmp_path, fit)).segment_each([image], [(rows // 2, columns // 2)])
    assert labels.shape == (rows // 2, columns // 2)
    assert set(np.unique(labels)) == {2, 3, 10}
    middle, right = labels[rows // 3], labels[:, -3]
    # Half of the logits' stride in the image, at half size: what a box filter of that stride can place.
    tolerance = max(columns / 160, rows / 96)
    assert np.sum(middle == 3) == pytest.approx(columns / 6, abs=tolerance)
    assert np.sum(right == 2) == pytest.approx(rows / 8, abs=tolerance)


def rows_of(boxes, classes, scores, objectness=None, count=8):
    """Rows of a head: centre, size, [objectness], classes."""
    boxes = np.array(boxes, np.float32)
    likelihood = np.zeros((len(boxes), count), np.float32)
    likelihood[np.arange(len(boxes)), classes] = scores
    parts = [(boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2], likelihood]
    if objectness is not None:
        parts.insert(2, np.array(objectness, np.float32)[:, None])
    return np.concatenate(parts, axis=1)[None]


BOXES = [[10, 20, 50, 60], [100, 30, 140, 80], [101, 31, 141, 81]]


@pytest.mark.parametrize("fit", ["letterbox_top_left", "letterbox_centre"])
@pytest.mark.parametrize("layout", ["yolov5", "yolov8"])
def test_yolo_heads_give_boxes_in_full_image_pixels(tmp_path, layout, fit):
    answer = rows_of(BOXES, [2, 0, 0], [0.9, 0.8, 0.7], [1.0, 0.5, 0.5] if layout == "yolov5" else None)
    answer = answer if layout == "yolov5" else answer.transpose(0, 2, 1)
    model = detector(tmp_path, answer, layout, fit=fit)
    found = model.detect(np.zeros((192, 400, 3), np.uint8))  # scale 0.4: 76.8 of 96 rows are image
    offset = 0 if fit == "letterbox_top_left" else (96 - 77) // 2
    assert found.classes == ["car", "person"]  # the third box is the second one again
    assert found.scores == pytest.approx([0.9, 0.4 if layout == "yolov5" else 0.8])
    scale = np.array([400 / 160, 192 / 77] * 2)
    assert found.boxes_px[0] == pytest.approx((np.array(BOXES[0]) - [0, offset, 0, offset]) * scale, abs=1e-3)


def test_a_yolox_head_is_decoded_on_its_grid():
    output = np.zeros((1, 12 * 20 + 6 * 10, 5 + 8), np.float32)  # strides 8 and 16 on 96 x 160
    cell = 12 * 20 + 3 * 10 + 4  # stride 16, row 3, column 4
    output[0, cell] = [0.5, 0.25, np.log(2.0), np.log(3.0), 0.5, 0, 0, 0.8, 0, 0, 0, 0, 0]
    found = decode_head(output, "yolox", (96, 160), (8, 16), "m.toml", 8)
    best = int(np.argmax(found.scores))
    assert best == cell
    assert found.scores[best] == pytest.approx(0.4)
    assert found.classes[best] == 2
    x, y = (4 + 0.5) * 16, (3 + 0.25) * 16
    assert found.boxes[best] == pytest.approx([x - 16, y - 24, x + 16, y + 24])


def test_tiles_report_each_object_once_and_none_that_a_tile_cuts(tmp_path):
    # Every tile answers the same two boxes: one inside, one at the right edge, cut by all tiles but the last.
    answer = rows_of([[60, 30, 90, 60], [140, 30, 160, 60]], [2, 2], [0.9, 0.8], [1.0, 1.0])
    model = detector(tmp_path, answer, "yolov5", tile_scales=[0.5], tile_overlap=0.25)
    found = model.detect(np.zeros((192, 800, 3), np.uint8))  # 400 x 96 at half size: tiles at 0, 120, 240
    assert found.boxes_px[found.scores > 0.85][:, 0].tolist() == [120, 360, 600]
    assert found.boxes_px[found.scores < 0.85].tolist() == [[760, 60, 800, 120]]


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ('path = "seg.onnx"', 'path = "none.onnx"', "path"),
        ('sha256 = "', 'sha256 = "00', "sha256"),
        ("[input]", 'colour = "rgb"\n[input]', "colour"),
        ('task = "segment"', 'task = "detect"', "layout"),
        ("size = [96, 160]", "size = [96]", "input.size"),
        ("size = [96, 160]", "size = [64, 64]", r"input\.size"),
        ("size = [96, 160]", "size = [96, 160]\nstd = [0, 1, 1]", "std"),
        ('label_set = "ade20k"', 'label_set = "kitti"', "label_set"),
        ("[output]", "[output", "TOML"),
    ],
)
def test_a_wrong_manifest_is_refused_by_key(tmp_path, old, new, key):
    file = segmenter(tmp_path).file
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(ModelError, match=key) as error:
        Segmenter(load_manifest(file, "segment"))
    assert str(file) in str(error.value)


def test_another_file_another_task_no_model_and_no_manifest_are_refused(tmp_path):
    file = segmenter(tmp_path).file
    with pytest.raises(ModelError, match="task"):
        load_manifest(file, "detect")
    with pytest.raises(ModelError, match="no such manifest"):
        load_manifest(tmp_path / "none.toml", "detect")
    (tmp_path / "seg.onnx").write_bytes(b"no model")
    with pytest.raises(ModelError, match="sha256"):
        load_manifest(file, "segment")
    (tmp_path / "m.onnx").write_bytes(b"no model")
    with pytest.raises(ModelError, match="onnxruntime"):
        Detector(
            manifest_of(tmp_path, "detect", {"size": [96, 160]}, {"layout": "yolov5", "label_set": "coco"})
        )


ROWS = rows_of(BOXES, [2, 0, 0], [0.9, 0.8, 0.7], [1.0] * 3)


@pytest.mark.parametrize(
    ("answer", "layout", "label_set", "error", "words"),
    [
        (np.zeros((1, 10, 13)), "yolox", "road_users", ModelError, "strides"),
        (np.zeros((1, 3, 9)), "yolov8", "road_users", ModelOutputError, "layout"),
        (ROWS, "yolov5", "coco", ModelOutputError, "8 classes in .* its label set has 80"),
        (ROWS * np.nan, "yolov5", "road_users", ModelOutputError, "NaN"),
        (np.zeros((1, 150, 24, 40)), "logits", "cityscapes", ModelOutputError, "19 or 20 x h x w"),
        (np.full((1, 24, 40), 42.0), "labels", "cityscapes", ModelOutputError, r"0\.\.19 or 255.* 42 to 42"),
        (np.full((1, 19, 24, 40), np.nan), "logits", "cityscapes", ModelOutputError, "NaN"),
    ],
)
def test_answers_of_another_shape_of_other_classes_or_of_no_numbers_are_refused(
    tmp_path, answer, layout, label_set, error, words
):
    with pytest.raises(error, match=words):
        runner(tmp_path, answer, layout, label_set)(PICTURE)


def runner(folder, answer, layout, label_set):
    """Runs a constant model on a picture."""
    if layout.startswith("yolo"):
        return detector(folder, answer, layout, label_set).detect
    model = answering(folder, answer, layout, label_set)
    return lambda picture: model.segment_each([picture], [(48, 80)])


@pytest.mark.parametrize(
    "model",
    [(ROWS, "yolov5", "road_users"), (np.zeros((1, 19, 24, 40)), "logits", "cityscapes")],
    ids=["detector", "segmenter"],
)
def test_a_model_that_answers_every_picture_alike_is_refused_and_a_stuck_camera_is_not_its_fault(
    tmp_path, model
):
    run = runner(tmp_path, *model)
    pictures = [np.full_like(PICTURE, shade) for shade in range(4)]
    for picture in [pictures[0]] * 9 + pictures[:3]:
        run(picture)
    with pytest.raises(ModelOutputError, match="same answer for 4 different inputs"):
        run(pictures[3])


def days(folder, made_frame, section=""):
    """Fleet and lake of three frames without logged semantics, the second one broken."""
    (folder / "fleet.toml").write_text(
        '[fleet]\nname = "made"\n[rigs.default.camera]\nimage = "/i"\ninfo = "/c"\n'
        'semantics = { source = "onnx", segmenter = "seg.toml", detector = "det.toml" }\n'
        f'[rigs.default.lidar]\npoints = "/p"\n[vehicles.car-1]\n[perceive]\n{section}\n'
    )
    lake = Lake.at(folder / f"lake-{section[:5]}")
    bare = dict.fromkeys(("labels_png", "detection_boxes_px", "detection_classes", "detection_scores"))
    frames = [replace(made_frame(i), sensors=["camera", "lidar"], **bare) for i in range(3)]
    write_frames(lake, DAY, [frames[0], replace(frames[1], image=b"broken"), frames[2]])
    return load_fleet(folder / "fleet.toml"), lake


def test_a_day_is_perceived_with_models_and_anew_with_another_model(tmp_path, made_frame):
    segmenter(tmp_path)
    keys = []
    for category, name in ((2, "car"), (0, "person")):
        detector(tmp_path, rows_of(BOXES, [category, 0, 0], [0.9, 0.4, 0.2], [1.0] * 3), "yolov5")
        fleet, lake = days(tmp_path, made_frame, "detection_min_score = 0.5")
        result = perceive_day(DAY, fleet, lake)
        assert (result.status, result.rows, result.rejected) == ("done", 2, {"image_undecodable": 1})
        found = list(observations_of(lake, DAY))
        assert [o.road_user_classes for o in found] == [[name]] * 2
        labels = cv2.imdecode(np.frombuffer(found[0].labels_png, np.uint8), cv2.IMREAD_UNCHANGED)
        assert labels.shape == (made_frame().image_height_px // 2, made_frame().image_width_px // 2)
        assert 0 < np.mean(labels == 3) < 1
        assert perceive_day(DAY, fleet, lake).status == "cached"
        keys.append(result.work_key)
    assert len(set(keys)) == 2

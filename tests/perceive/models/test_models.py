"""Models behind manifests: heads, letterboxes, alignment of logits, and errors that name manifest and key."""

from dataclasses import replace

import numpy as np
import onnxruntime
import pytest

from pipeline.core.config import load_fleet
from pipeline.core.errors import ModelError, ModelOutputError
from pipeline.core.memory import MODEL_THREADS, usable_cpus
from pipeline.core.rigs import OnnxSemantics
from pipeline.perceive.models.detector import Candidates, Detector, decode_head, suppress
from pipeline.perceive.models.manifest import InputSpec, load_manifest
from pipeline.perceive.models.segmenter import Segmenter
from pipeline.perceive.models.session import Fit, fit_image, model_threads
from pipeline.perceive.models.source import ModelSource
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from tests.makers.fleet_files import fleet_toml
from tests.makers.lakes import write_frames
from tests.makers.onnx_models import save_constant, save_segmenter, write_manifest
from tests.makers.stages import perceive_day

COLOURS = [[0.2, 0.2, 0.2], [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]]  # RGB of ADE20K wall, building, sky
FITS = ("letterbox_top_left", "letterbox_centre", "stretch")


def segmenter(folder, fit="stretch", size=(96, 160), stride=4):
    save_segmenter(folder / "seg.onnx", size, stride, COLOURS)
    given = {"size": list(size), "scale": 1 / 255, "fit": fit, "pad": 128.0}
    output = {"layout": "logits", "label_set": "ade20k"}
    return load_manifest(
        write_manifest(folder / "seg.toml", folder / "seg.onnx", "segment", given, output), "segment"
    )


def detector(folder, answer, layout, *, size=(96, 160), given=None, label_set="road_users", **output):
    save_constant(folder / "det.onnx", answer, size)
    text = write_manifest(
        folder / "det.toml", folder / "det.onnx", "detect",
        {"size": list(size), "fit": "letterbox_top_left"} | (given or {}),
        {"layout": layout, "label_set": label_set} | output,
    )  # fmt: skip
    return Detector(load_manifest(text, "detect"))


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


def test_interpolated_logits_place_a_boundary_finer_than_their_stride(tmp_path):
    model = Segmenter(segmenter(tmp_path, size=(96, 160), stride=8))
    errors = []
    for edge in range(60, 100):
        image = np.full((96, 160, 3), 51, np.uint8)
        image[:, edge:] = (230, 26, 26)
        [labels] = model.segment_each([image], [(96, 160)])
        errors.append(np.sum(labels[40] == 3) - edge)
    assert abs(np.mean(errors)) < 0.6
    assert np.max(np.abs(errors)) <= 2  # nearest would err by up to 4


def test_plain_label_outputs_are_resampled_with_aligned_centres(tmp_path):
    answer = np.zeros((1, 24, 40), np.float32)
    answer[:, :, 10:] = 10
    save_constant(tmp_path / "m.onnx", answer)
    given, output = {"size": [96, 160], "fit": "stretch"}, {"layout": "labels", "label_set": "cityscapes"}
    manifest = load_manifest(
        write_manifest(tmp_path / "m.toml", tmp_path / "m.onnx", "segment", given, output), "segment"
    )
    [labels] = Segmenter(manifest).segment_each([np.zeros((192, 320, 3), np.uint8)], [(96, 160)])
    assert np.array_equal(np.unique(labels, return_counts=True)[1], [96 * 40, 96 * 120])


@pytest.mark.parametrize("fit", FITS)
def test_a_box_in_the_models_input_comes_back_to_the_image(fit):
    image = np.zeros((300, 410, 3), np.uint8)
    image[100:160, 50:120] = 255
    tensor, where = fit_image(image, InputSpec(size=(96, 160), fit=fit, pad=0.0))
    rows, columns = np.nonzero(tensor[0, 0] > 127)
    x = (np.array([columns.min(), columns.max() + 1]) - where.offset_x) / where.scale_x
    y = (np.array([rows.min(), rows.max() + 1]) - where.offset_y) / where.scale_y
    assert x == pytest.approx([50, 120], abs=2.6)
    assert y == pytest.approx([100, 160], abs=2.6)


def test_colours_and_normalisation_follow_the_manifest():
    image = np.zeros((8, 8, 3), np.uint8)
    image[:] = (10, 20, 30)  # BGR
    spec = {"size": (8, 8), "mean": (1.0, 2.0, 3.0), "std": (2.0, 4.0, 8.0)}
    rgb = fit_image(image, InputSpec(**spec, colour="rgb"))[0][0, :, 0, 0]
    bgr = fit_image(image, InputSpec(**spec, colour="bgr"))[0][0, :, 0, 0]
    assert rgb == pytest.approx([29 / 2, 18 / 4, 7 / 8])
    assert bgr == pytest.approx([9 / 2, 18 / 4, 27 / 8])
    assert fit_image(image, InputSpec(size=(8, 16)))[1] == Fit(1.0, 1.0, 4, 0, 8, 8)


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
    model = detector(tmp_path, answer, layout, given={"fit": fit})
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


def test_suppression_works_within_a_class_only():
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [0, 0, 10, 10], [50, 50, 60, 60]], np.float32)
    found = Candidates(boxes, np.array([0.5, 0.9, 0.4, 0.1], np.float32), np.array([2, 2, 0, 2]))
    assert suppress(found, 0.5).tolist() == [1, 2, 3]
    assert suppress(found, 1.0).tolist() == [1, 0, 2, 3]


def test_classes_that_are_no_road_users_are_left_out(tmp_path):
    answer = rows_of(BOXES[:2], [4, 2], [0.9, 0.8], [1.0, 1.0], count=80)  # COCO 4 is an airplane
    assert detector(tmp_path, answer, "yolov5", label_set="coco").detect(
        np.zeros((96, 160, 3), np.uint8)
    ).classes == ["car"]


def test_tiles_report_each_object_once_and_none_that_a_tile_cuts(tmp_path):
    # Every tile answers the same two boxes: one inside, one at the right edge, cut by all tiles but the last.
    answer = rows_of([[60, 30, 90, 60], [140, 30, 160, 60]], [2, 2], [0.9, 0.8], [1.0, 1.0])
    model = detector(tmp_path, answer, "yolov5", given={"tile_scales": [0.5], "tile_overlap": 0.25})
    found = model.detect(np.zeros((192, 800, 3), np.uint8))  # 400 x 96 at half size: tiles at 0, 120, 240
    assert found.boxes_px[found.scores > 0.85][:, 0].tolist() == [120, 360, 600]
    assert found.boxes_px[found.scores < 0.85].tolist() == [[760, 60, 800, 120]]


def good_manifest(folder):
    segmenter(folder)
    return folder / "seg.toml"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('path = "seg.onnx"', 'path = "none.onnx"', "path"),
        ('sha256 = "', 'sha256 = "00', "sha256"),
        ("[input]", 'colour = "rgb"\n[input]', "colour"),
        ('task = "segment"', 'task = "detect"', "layout"),
        ("size = [96, 160]", "size = [96]", "input.size"),
        ("size = [96, 160]", "size = [96, 160]\nstd = [0, 1, 1]", "std"),
        ('label_set = "ade20k"', 'label_set = "kitti"', "label_set"),
        ("[output]", "[output", "TOML"),
    ],
)
def test_a_wrong_manifest_is_refused_by_key(tmp_path, old, new, words):
    path = good_manifest(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ModelError, match=words) as error:
        load_manifest(path, "segment")
    assert str(path) in str(error.value)


def test_another_model_file_than_the_manifest_means_is_refused(tmp_path):
    path = good_manifest(tmp_path)
    with (tmp_path / "seg.onnx").open("ab") as stream:
        stream.write(b"x")
    with pytest.raises(ModelError, match="sha256"):
        load_manifest(path, "segment")


def test_a_manifest_of_the_other_task_and_a_missing_one_are_refused(tmp_path):
    with pytest.raises(ModelError, match="task"):
        load_manifest(good_manifest(tmp_path), "detect")
    with pytest.raises(ModelError, match="no such manifest"):
        load_manifest(tmp_path / "none.toml", "detect")


@pytest.mark.parametrize(
    ("shape", "layout", "words"),
    [((1, 10, 13), "yolox", "strides"), ((10, 13), "yolov5", "layout"), ((1, 3, 9), "yolov8", "layout")],
)
def test_a_head_of_another_shape_than_its_layout_is_refused(tmp_path, shape, layout, words):
    model = detector(tmp_path, np.zeros(shape, np.float32), layout)
    with pytest.raises(ModelError, match=words):
        model.detect(np.zeros((96, 160, 3), np.uint8))


def answering(folder, answer, layout, label_set="cityscapes"):
    """A segmenter that gives this answer to every picture."""
    save_constant(folder / "m.onnx", answer)
    given, output = {"size": [96, 160], "fit": "stretch"}, {"layout": layout, "label_set": label_set}
    return Segmenter(
        load_manifest(
            write_manifest(folder / "m.toml", folder / "m.onnx", "segment", given, output), "segment"
        )
    )


@pytest.mark.parametrize(
    ("answer", "layout", "words"),
    [
        (np.zeros((1, 150, 24, 40)), "logits", "must be 1 x 19 or 20 x h x w"),
        (np.full((1, 24, 40), 42.0), "labels", r"must be one image of 0\.\.19 or 255.* 42 to 42"),
        (np.full((1, 19, 24, 40), np.nan), "logits", "NaN"),
        (np.full((1, 24, 40), np.nan), "labels", "NaN"),
    ],
)
def test_answers_of_other_classes_or_of_no_numbers_are_refused(tmp_path, answer, layout, words):
    model = answering(tmp_path, answer, layout)
    with pytest.raises(ModelError, match=words):
        model.segment_each([np.zeros((96, 160, 3), np.uint8)], [(48, 80)])


def test_a_model_that_answers_every_picture_alike_is_refused_and_a_stuck_camera_is_not_its_fault(tmp_path):
    model = answering(tmp_path, np.zeros((1, 19, 24, 40)), "logits")
    pictures = [np.full((96, 160, 3), shade, np.uint8) for shade in range(4)]
    for picture in [pictures[0]] * 9 + pictures[:3]:
        model.segment_each([picture], [(48, 80)])
    with pytest.raises(ModelOutputError, match="same answer for 4 different inputs"):
        model.segment_each([pictures[3]], [(48, 80)])


def test_a_detector_of_other_classes_or_of_no_numbers_is_refused(tmp_path):
    picture, rows = np.zeros((96, 160, 3), np.uint8), rows_of(BOXES, [2, 0, 0], [0.9, 0.8, 0.7], [1.0] * 3)
    with pytest.raises(ModelOutputError, match=r"8 classes in .* its label set has 80"):
        detector(tmp_path, rows, "yolov5", label_set="coco").detect(picture)
    with pytest.raises(ModelOutputError, match=r"80 classes in .* its label set has 8"):
        detector(tmp_path, np.zeros((1, 84, 9)), "yolov8").detect(picture)
    rows[0, 0, 0] = np.nan
    with pytest.raises(ModelOutputError, match="NaN"):
        detector(tmp_path, rows, "yolov5").detect(picture)


def test_a_detector_that_answers_every_picture_alike_is_refused_and_a_stuck_camera_is_not_its_fault(tmp_path):
    model = detector(tmp_path, rows_of(BOXES, [2, 0, 0], [0.9, 0.8, 0.7], [1.0] * 3), "yolov5")
    pictures = [np.full((96, 160, 3), shade, np.uint8) for shade in range(4)]
    for picture in [pictures[0]] * 9 + pictures[:3]:
        model.detect(picture)
    with pytest.raises(ModelOutputError, match="same answer for 4 different inputs"):
        model.detect(pictures[3])


def test_a_size_that_the_model_does_not_take_is_refused_on_loading(tmp_path):
    save_constant(tmp_path / "m.onnx", np.zeros((1, 3, 13), np.float32))
    given, output = {"size": [64, 64]}, {"layout": "yolov5", "label_set": "coco"}
    path = write_manifest(tmp_path / "m.toml", tmp_path / "m.onnx", "detect", given, output)
    with pytest.raises(ModelError, match=r"input\.size"):
        Detector(load_manifest(path, "detect"))


def test_a_file_that_is_no_model_is_refused(tmp_path):
    (tmp_path / "m.onnx").write_bytes(b"no model")
    given, output = {"size": [96, 160]}, {"layout": "yolov5", "label_set": "coco"}
    path = write_manifest(tmp_path / "m.toml", tmp_path / "m.onnx", "detect", given, output)
    with pytest.raises(ModelError, match="onnxruntime"):
        Detector(load_manifest(path, "detect"))


def test_both_models_together_give_a_frames_semantics(tmp_path, made_frame):
    segmenter(tmp_path)
    detector(tmp_path, rows_of(BOXES, [2, 0, 0], [0.9, 0.8, 0.2], [1.0, 1.0, 1.0]), "yolov5")
    wanted = OnnxSemantics(source="onnx", segmenter="seg.toml", detector="det.toml")
    (tmp_path / "fleet.toml").write_text(
        fleet_toml("car-1", sections="[perceive]\ndetection_min_score = 0.5")
    )
    source = ModelSource.load(wanted, load_fleet(tmp_path / "fleet.toml"))
    frame = made_frame()
    found = source.read(frame)
    assert found.labels.shape == (frame.image_height_px // 2, frame.image_width_px // 2)
    assert found.detections.classes == ["car", "person"]
    assert 0 < np.mean(found.labels == 3) < 1


def test_a_day_is_perceived_with_models_and_anew_with_another_model(tmp_path, made_frame):
    segmenter(tmp_path)
    detector(tmp_path, rows_of(BOXES[:1], [2], [0.9], [1.0]), "yolov5")
    toml = tmp_path / "fleet.toml"
    toml.write_text(
        '[fleet]\nname = "made"\n[rigs.default.camera]\nimage = "/i"\ninfo = "/c"\n'
        'semantics = { source = "onnx", segmenter = "seg.toml", detector = "det.toml" }\n'
        '[rigs.default.lidar]\npoints = "/p"\n[rigs.default.radar]\npoints = "/r"\n[vehicles.car-1]\n'
    )
    lake, day = Lake.at(tmp_path / "lake"), Partition("car-1", "2026-03-02")
    # The car logged no semantics: the models give them.
    bare = dict.fromkeys(("labels_png", "detection_boxes_px", "detection_classes", "detection_scores"))
    write_frames(lake, day, [replace(made_frame(i), **bare) for i in range(2)])
    first = perceive_day(day, load_fleet(toml), lake)
    assert (first.status, first.rows) == ("done", 2)
    assert [o.road_user_classes for o in list(observations_of(lake, day))] == [
        ["car"],
        ["car"],
    ]
    assert perceive_day(day, load_fleet(toml), lake).status == "cached"
    detector(tmp_path, rows_of(BOXES[:1], [0], [0.9], [1.0]), "yolov5")
    again = perceive_day(day, load_fleet(toml), lake)
    assert again.status == "done"
    assert [o.road_user_classes for o in list(observations_of(lake, day))] == [
        ["person"],
        ["person"],
    ]


def test_frames_in_batches_and_another_provider_give_the_same_day_under_the_same_work_key(
    tmp_path, made_frame
):
    segmenter(tmp_path)
    detector(tmp_path, rows_of(BOXES[:1], [2], [0.9], [1.0]), "yolov5")
    frames = [made_frame(i) for i in range(5)]
    frames[1] = replace(frames[1], image=b"broken")
    found, keys, reasons = [], [], []
    for number, section in enumerate(
        ("", "batch = 3", 'providers = ["CUDAExecutionProvider", "CPUExecutionProvider"]')
    ):
        toml = tmp_path / "fleet.toml"
        toml.write_text(
            '[fleet]\nname = "made"\n[rigs.default.camera]\nimage = "/i"\ninfo = "/c"\n'
            'semantics = { source = "onnx", segmenter = "seg.toml", detector = "det.toml" }\n'
            f'[rigs.default.lidar]\npoints = "/p"\n[vehicles.car-1]\n[perceive]\n{section}\n'
        )
        lake, day = Lake.at(tmp_path / f"lake-{number}"), Partition("car-1", "2026-03-02")
        write_frames(lake, day, [replace(f, sensors=["camera", "lidar"]) for f in frames])
        outcome = perceive_day(day, load_fleet(toml), lake)
        assert (outcome.rows, outcome.rejected) == (4, {"image_undecodable": 1})
        found.append([(o.labels_png, o.road_user_classes) for o in observations_of(lake, day)])
        keys.append(outcome.work_key)
        reasons.append(outcome.reason)
    assert found[0] == found[1] == found[2]
    assert len(set(keys)) == 1
    has_cuda = "CUDAExecutionProvider" in onnxruntime.get_available_providers()
    told = "models ran on CPUExecutionProvider: CUDAExecutionProvider could not be had"
    assert reasons == ["", "", "" if has_cuda else told]


def test_a_provider_that_is_not_there_is_told_with_what_to_install(tmp_path):
    manifest = segmenter(tmp_path)
    if "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        with pytest.raises(ModelError, match=r"perceive.providers: .* pip install 'boresight\[gpu\]'"):
            Segmenter(manifest, ["CUDAExecutionProvider"])
    with pytest.raises(ModelError, match=r"this onnxruntime has .* not NoExecutionProvider"):
        Segmenter(manifest, ["NoExecutionProvider"])
    assert Segmenter(manifest, ["CPUExecutionProvider"]).provider == "CPUExecutionProvider"


def test_a_model_uses_the_share_of_its_worker_or_all_that_the_process_may(monkeypatch):
    for name in (MODEL_THREADS, "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    assert model_threads() == usable_cpus()
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert model_threads() == 1
    monkeypatch.setenv(MODEL_THREADS, "3")
    assert model_threads() == 3

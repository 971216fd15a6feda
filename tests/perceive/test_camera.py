"""Semantics from topics: alignment of label images, and every way a frame can be unusable."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.core.config import PerceiveConfig
from pipeline.core.rigs import TopicSemantics
from pipeline.perceive.camera import TopicSource, decode_grey, encode_png, label_size, resize_labels
from pipeline.perceive.rejections import FrameReason, FrameRejectedError

TOPICS = TopicSemantics(source="topics", labels="/l", detections="/d")


def source(scale=0.5):
    return TopicSource(TOPICS, PerceiveConfig(label_scale=scale))


def boundary(row: np.ndarray) -> float:
    """Where a row changes from 0 to 1, in its own pixels with pixel centres at integers."""
    return float(np.sum(row == 0)) - 0.5


@pytest.mark.parametrize(
    ("width", "scale"), [(600, 0.5), (600, 1 / 3), (600, 0.25), (512, 0.75), (1000, 0.4)]
)
def test_boundaries_stay_where_they_are_when_labels_are_resized(width, scale):
    # Pixel u of the image is pixel (u + 0.5) * scale - 0.5 of the label image, for every boundary on average.
    shifts = []
    for edge in range(100, 400, 7):
        labels = np.zeros((16, width), np.uint8)
        labels[:, edge:] = 1
        small = resize_labels(labels, label_size(width, 16, scale))
        shifts.append(boundary(small[small.shape[0] // 2]) - ((edge - 0.5 + 0.5) * scale - 0.5))
    assert abs(np.mean(shifts)) < 0.30  # half a label pixel is the most that rounding to whole pixels allows
    assert np.max(np.abs(shifts)) <= 0.5 + 1e-9


def test_halving_labels_treats_left_and_right_alike():
    # One object's two boundaries must not both move the same way.
    wide = []
    for left in range(100, 110):
        labels = np.full((8, 400), 1, np.uint8)
        labels[:, left : left + 51] = 13
        small = resize_labels(labels, (4, 200))[2]
        columns = np.flatnonzero(small == 13)
        wide.append((columns[0] + columns[-1]) / 2 - ((left + 25 + 0.5) * 0.5 - 0.5))
    assert abs(np.mean(wide)) < 0.05


def test_halving_labels_takes_the_majority_and_invents_no_class():
    rng = np.random.default_rng(0)
    labels = rng.choice([0, 8, 13, 255], size=(40, 60)).astype(np.uint8)
    small = resize_labels(labels, (20, 30))
    blocks = labels.reshape(20, 2, 30, 2).swapaxes(1, 2).reshape(20, 30, 4)
    held = np.sum(blocks == small[..., None], axis=2)
    most = np.max(np.sum(blocks[..., None] == blocks[..., None, :], axis=3), axis=2)
    assert np.array_equal(held, most)


def test_logged_semantics_are_read_with_fractions_and_boxes_of_road_users_only(made_frame):
    frame = made_frame()
    found = source().read(frame)
    assert found.labels.shape == label_size(frame.image_width_px, frame.image_height_px, 0.5)
    logged = cv2.imdecode(np.frombuffer(frame.labels_png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert found.sky_fraction == pytest.approx(np.mean(logged == 10), abs=0.01)
    assert found.drivable_fraction == pytest.approx(np.mean(logged == 0), abs=0.01)
    assert found.detections.classes == ["car", "person"]  # the traffic light and the faint car are left out


def test_detections_that_are_no_boxes_are_left_out(made_frame):
    frame = made_frame()
    boxes = frame.detection_boxes_px.copy()
    boxes[0, 0] = np.nan
    assert source().read(replace(frame, detection_boxes_px=boxes)).detections.classes == ["person"]


def test_a_log_with_no_road_user_in_sight_is_no_fault(made_frame):
    empty = replace(
        made_frame(), detection_boxes_px=np.zeros((0, 4), np.float32), detection_classes=[],
        detection_scores=np.zeros(0, np.float32),
    )  # fmt: skip
    assert source().read(empty).detections.boxes_px.shape == (0, 4)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"labels_png": None}, FrameReason.NO_LABELS),
        ({"labels_png": b""}, FrameReason.UNDECODABLE_LABELS),
        ({"labels_png": b"\x89PNG\r\n\x1a\nbroken"}, FrameReason.UNDECODABLE_LABELS),
        ({"labels_png": encode_png(np.zeros((50, 50), np.uint8))}, FrameReason.LABELS_SHAPE),
        ({"detection_boxes_px": None}, FrameReason.NO_DETECTIONS),
        ({"detection_classes": ["car"]}, FrameReason.BAD_DETECTIONS),
    ],
)
def test_unusable_semantics_reject_the_frame_with_a_reason(made_frame, change, reason):
    with pytest.raises(FrameRejectedError) as rejection:
        source().read(replace(made_frame(), **change))
    assert rejection.value.reason is reason


def test_colour_label_images_are_no_labels(made_frame):
    colour = cv2.imencode(".png", np.zeros((120, 200, 3), np.uint8))[1].tobytes()
    with pytest.raises(FrameRejectedError) as rejection:
        source().read(replace(made_frame(), labels_png=colour))
    assert rejection.value.reason is FrameReason.UNDECODABLE_LABELS


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.3])
def test_the_grey_image_lies_on_the_label_image(made_frame, scale):
    # Bright bars at known places must be found there at every scale, whichever way JPEG is decoded.
    frame, errors = made_frame(), []
    for left in range(190, 210):
        image = np.full((frame.image_height_px, frame.image_width_px, 3), 40, np.uint8)
        image[:, left : left + 40] = 220
        grey = decode_grey(replace(frame, image=cv2.imencode(".jpg", image)[1].tobytes()), scale)
        assert grey.shape == label_size(frame.image_width_px, frame.image_height_px, scale)
        weight = np.clip(grey.astype(float).mean(axis=0) - 60, 0, None)
        centre = np.sum(weight * np.arange(len(weight))) / np.sum(weight)
        errors.append(centre - ((left + 19.5 + 0.5) * scale - 0.5))
    assert np.max(np.abs(errors)) < 0.1


def test_broken_and_foreign_images_are_rejected(made_frame):
    frame = made_frame()
    other = cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes()
    for image, reason in (
        (b"", FrameReason.UNDECODABLE_IMAGE),
        (b"no image", FrameReason.UNDECODABLE_IMAGE),
        (other, FrameReason.IMAGE_SIZE),
    ):
        with pytest.raises(FrameRejectedError) as rejection:
            decode_grey(replace(frame, image=image), 0.5)
        assert rejection.value.reason is reason


def test_classes_of_a_detectors_own_become_road_users(made_frame):
    frame = made_frame()
    boxes = np.array([[1, 1, 20, 20], [30, 5, 60, 40]], np.float32)
    two = {
        "detection_boxes_px": boxes,
        "detection_classes": ["2", "17"],
        "detection_scores": np.ones(2, np.float32),
    }
    frame = replace(frame, **two)
    assert source().read(frame).detections.classes == []
    topics = TOPICS.model_copy(update={"classes": {"2": "truck"}})
    assert TopicSource(topics, PerceiveConfig()).read(frame).detections.classes == ["truck"]

"""Semantics from topics: alignment of label images, and every way a frame can be unusable."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.core.config import PerceiveConfig
from pipeline.core.rigs import TopicSemantics
from pipeline.perceive.camera import (
    FrameReason,
    FrameRejectedError,
    TopicSource,
    decode_grey,
    label_size,
    resize_labels,
)

TOPICS = TopicSemantics(source="topics", labels="/l", detections="/d")
OWN_CLASSES = TOPICS.model_copy(update={"classes": {"2": "truck"}})


def png_of(shape):
    return cv2.imencode(".png", np.zeros(shape, np.uint8))[1].tobytes()


def read(frame, topics=TOPICS):
    return TopicSource(topics, PerceiveConfig(label_scale=0.5)).read(frame)


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
        shifts.append(np.sum(small[small.shape[0] // 2] == 0) - edge * scale)
    assert abs(np.mean(shifts)) < 0.30  # half a label pixel is the most that rounding to whole pixels allows
    assert np.max(np.abs(shifts)) <= 0.5 + 1e-9


def test_halving_labels_takes_the_majority_and_invents_no_class():
    labels = np.random.default_rng(0).choice([0, 8, 13, 255], size=(40, 60)).astype(np.uint8)
    small = resize_labels(labels, (20, 30))
    blocks = labels.reshape(20, 2, 30, 2).swapaxes(1, 2).reshape(20, 30, 4)
    held = np.sum(blocks == small[..., None], axis=2)
    most = np.max(np.sum(blocks[..., None] == blocks[..., None, :], axis=3), axis=2)
    assert np.array_equal(held, most)


@pytest.mark.parametrize(
    ("topics", "change", "classes"),
    [
        (TOPICS, {}, ["car", "person"]),  # the traffic light and the faint car are left out
        (TOPICS, {"boxes_px": [[np.nan, 1, 20, 20], [30, 5, 60, 40], *[[1, 1, 20, 20]] * 2]}, ["person"]),
        (TOPICS, {"boxes_px": np.zeros((0, 4)), "classes": [], "scores": []}, []),
        (TOPICS, {"classes": ["2", "17", "", ""]}, []),
        (OWN_CLASSES, {"classes": ["2", "17", "", ""]}, ["truck"]),
    ],
    ids=["all", "no box", "nobody in sight", "numbers", "numbers with names"],
)
def test_detections_are_boxes_of_road_users_that_are_sure_enough(made_frame, topics, change, classes):
    kinds = {"boxes_px": np.float32, "scores": np.float32, "classes": object}
    change = {f"detection_{k}": np.array(v, kinds[k]) for k, v in change.items()}
    if "detection_classes" in change:
        change["detection_classes"] = change["detection_classes"].tolist()
    found = read(replace(made_frame(), **change), topics).detections
    assert (found.classes, found.boxes_px.shape) == (classes, (len(classes), 4))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"labels_png": None}, FrameReason.NO_LABELS),
        ({"labels_png": b""}, FrameReason.UNDECODABLE_LABELS),
        ({"labels_png": b"\x89PNG\r\n\x1a\nbroken"}, FrameReason.UNDECODABLE_LABELS),
        ({"labels_png": png_of((120, 200, 3))}, FrameReason.UNDECODABLE_LABELS),
        ({"labels_png": png_of((50, 50))}, FrameReason.LABELS_SHAPE),
        ({"detection_boxes_px": None}, FrameReason.NO_DETECTIONS),
        ({"detection_classes": ["car"]}, FrameReason.BAD_DETECTIONS),
        ({"image": b""}, FrameReason.UNDECODABLE_IMAGE),
        ({"image": b"no image"}, FrameReason.UNDECODABLE_IMAGE),
        ({"image": png_of((64, 64, 3))}, FrameReason.IMAGE_SIZE),
    ],
)
def test_unusable_pictures_and_semantics_reject_the_frame_with_a_reason(made_frame, change, reason):
    frame = replace(made_frame(), **change)
    with pytest.raises(FrameRejectedError) as rejection:
        decode_grey(frame, 0.5) if "image" in change else read(frame)
    assert rejection.value.reason is reason


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

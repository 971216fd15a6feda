"""A real third-party detector on real images finds what the car's own software logged."""

import hashlib
from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.core.third_party_models import manifest_text, named
from pipeline.perceive.labels import road_user_name
from pipeline.perceive.models.detector import Detector
from pipeline.perceive.models.manifest import load_manifest

pytestmark = [pytest.mark.real_logs]

FRAMES = 16


def images_and_boxes(log):
    """Images of one log, with the boxes and classes logged at their stamps."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    images, logged = {}, {}
    topics = ["/camera/front/image/compressed", "/perception/camera/detections"]
    with log.open("rb") as stream:
        for _, channel, _, message in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages(topics):
            stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
            (images if channel.topic == topics[0] else logged)[stamp] = message
    for stamp in sorted(images.keys() & logged.keys())[:: max(1, len(images) // FRAMES)][:FRAMES]:
        boxes, classes = [], []
        for d in logged[stamp].detections:
            c, w, h = d.bbox.center.position, d.bbox.size_x, d.bbox.size_y
            boxes.append([c.x - w / 2, c.y - h / 2, c.x + w / 2, c.y + h / 2])
            classes.append(road_user_name(d.results[0].hypothesis.class_id))
        image = cv2.imdecode(np.frombuffer(bytes(images[stamp].data), np.uint8), cv2.IMREAD_COLOR)
        yield image, np.array(boxes).reshape(-1, 4), classes


def iou(a, b):
    low, high = np.maximum(a[:2], b[:, :2]), np.minimum(a[2:], b[:, 2:])
    both = np.prod(np.clip(high - low, 0, None), axis=1)
    return both / (np.prod(a[2:] - a[:2]) + np.prod(b[:, 2:] - b[:, :2], axis=1) - both)


def test_yolox_nano_finds_the_logged_road_users(real_logs, real_detector, tmp_path):
    (tmp_path / "yolox-nano.onnx").symlink_to(real_detector)
    digest = hashlib.sha256(real_detector.read_bytes()).hexdigest()  # another export than the catalogue's
    (known,) = named(["yolox-nano"])
    (tmp_path / "yolox.toml").write_text(manifest_text(replace(known, sha256=digest)))
    detector = Detector(load_manifest(tmp_path / "yolox.toml", "detect"))
    total = matched = same_class = found = 0
    for image, boxes, classes in images_and_boxes(real_logs / "astyx-1_2019-01-14_00.mcap"):
        detections = detector.detect(image).at_least(0.3)
        found += len(detections.scores)
        for box, name in zip(boxes, classes, strict=True):
            total += 1
            overlap = iou(box, detections.boxes_px) if len(detections.scores) else np.zeros(1)
            best = int(np.argmax(overlap))
            matched += overlap[best] > 0.5
            same_class += overlap[best] > 0.5 and detections.classes[best] == name
    assert total > 50
    assert matched >= 0.9 * total  # the goal is 80 %; measured 0.97 over all recordings
    assert same_class >= 0.85 * total
    assert found < 2 * total  # not bought with boxes everywhere

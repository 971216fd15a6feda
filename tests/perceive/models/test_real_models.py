"""Real third-party models, by the manifests of the README and of the catalogue, agree with what a car logged."""

import hashlib
from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.core.models import manifest_text, named
from pipeline.perceive.labels import road_user_name
from pipeline.perceive.models.detector import Detector
from pipeline.perceive.models.manifest import load_manifest
from pipeline.perceive.models.source import Segmenter
from tests.makers.real_models import write_real_manifests

pytestmark = [pytest.mark.real_logs]

ROAD = 0


def images_with(topic, logs, count):
    """Images of one log, with the messages of a topic logged at their stamps."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    topics = ["/camera/front/image/compressed", topic]
    found = {topic: {} for topic in topics}
    with (logs / "astyx-1_2019-01-14_00.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics):
            found[channel.topic][message.header.stamp.sec, message.header.stamp.nanosec] = message
    images, logged = (found[topic] for topic in topics)
    for stamp in sorted(images.keys() & logged.keys())[:: len(images) // count][:count]:
        data = np.frombuffer(bytes(images[stamp].data), np.uint8)
        yield cv2.imdecode(data, cv2.IMREAD_COLOR), logged[stamp]


def images_and_labels(logs, count=3):
    for image, message in images_with("/perception/camera/labels", logs, count):
        yield image, cv2.imdecode(np.frombuffer(bytes(message.data), np.uint8), cv2.IMREAD_UNCHANGED)


def boxes_and_classes(message):
    corners = [
        (d.bbox.center.position.x, d.bbox.center.position.y, d.bbox.size_x / 2, d.bbox.size_y / 2)
        for d in message.detections
    ]
    names = [road_user_name(d.results[0].hypothesis.class_id) for d in message.detections]
    return [np.array([x - w, y - h, x + w, y + h]) for x, y, w, h in corners], names


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
    for image, message in images_with("/perception/camera/detections", real_logs, 16):
        detections = detector.detect(image).at_least(0.3)
        found += len(detections.scores)
        for box, name in zip(*boxes_and_classes(message), strict=True):
            total += 1
            overlap = iou(box, detections.boxes_px) if len(detections.scores) else np.zeros(1)
            best = int(np.argmax(overlap))
            matched += overlap[best] > 0.5
            same_class += overlap[best] > 0.5 and detections.classes[best] == name
    assert total > 50
    assert matched >= 0.9 * total  # the goal is 80 %; measured 0.97 over all recordings
    assert same_class >= 0.85 * total
    assert found < 2 * total  # not bought with boxes everywhere


@pytest.fixture
def segmenter_manifest(tmp_path, real_segmenter):
    write_real_manifests(tmp_path, real_segmenter, real_segmenter)
    return load_manifest(tmp_path / "segmenter.toml", "segment")


def test_espnetv2_labels_pixels_as_the_log_does(real_logs, segmenter_manifest):
    segmenter = Segmenter(segmenter_manifest)
    agreement, road = [], []
    for image, logged in images_and_labels(real_logs):
        [labels] = segmenter.segment_each([image], [logged.shape])
        known = logged != 255
        agreement.append(np.mean(labels[known] == logged[known]))
        road.append(np.sum((labels == ROAD) & (logged == ROAD)) / np.sum((labels == ROAD) | (logged == ROAD)))
    # Measured 0.84 and 0.86: how the car prepared its images and dilated its labels is not known.
    assert np.mean(agreement) > 0.8
    assert np.mean(road) > 0.8

"""Boxes in the camera's own frame become what they are in the image; boxes in any other frame are refused."""

from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from pipeline.ingest.messages.detections import read_detections_3d
from pipeline.rig.cameras import Camera

CAMERA = Camera("plumb_bob", np.array([[80.0, 0, 48], [0, 80, 32], [0, 0, 1]]), np.zeros(5), 96, 64)
_3D = {
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}


def xyz(x, y, z):
    return SimpleNamespace(x=x, y=y, z=z)


def pose(x, y, z, q=(1.0, 0.0, 0.0, 0.0)):
    return SimpleNamespace(position=xyz(x, y, z), orientation=SimpleNamespace(w=q[0], x=q[1], y=q[2], z=q[3]))


def autoware(*things, frame="camera_optical"):
    """Pose, size, label."""
    of = SimpleNamespace
    objects = [
        of(
            existence_probability=0.8, shape=of(dimensions=size),
            classification=[of(label=0, probability=0.1), of(label=label, probability=0.9)],
            kinematics=of(pose_with_covariance=of(pose=at)),
        )
        for at, size, label in things
    ]  # fmt: skip
    return SimpleNamespace(header=SimpleNamespace(frame_id=frame), objects=objects)


def test_a_box_in_the_camera_frame_is_where_its_nearest_corners_are_seen():
    # Its near face is 2 m high and 4 m wide at 8 m: 80 * 4 / 8 = 40 px wide, 20 px high about (48 + 80 * 1 / 8, 32).
    message = autoware((pose(1.0, 0.0, 10.0), xyz(4.0, 2.0, 4.0), 1))
    boxes, classes, scores, dropped = read_detections_3d(message, CAMERA, "camera_optical")
    np.testing.assert_allclose(boxes, [[38, 22, 78, 42]], atol=1e-5)
    assert (classes, scores.tolist(), dropped) == (["car"], pytest.approx([0.8]), 0)


def test_a_turned_box_is_wider_than_a_straight_one():
    half = np.radians(45) / 2
    turned = autoware((pose(0.0, 0.0, 10.0, (np.cos(half), 0.0, np.sin(half), 0.0)), xyz(4.0, 2.0, 2.0), 2))
    straight = autoware((pose(0.0, 0.0, 10.0), xyz(4.0, 2.0, 2.0), 2))
    a, b = (read_detections_3d(m, CAMERA, "camera_optical")[0][0] for m in (turned, straight))
    # Corners of the turned one at x = 3 / sqrt(2) and z = 10 - 1 / sqrt(2).
    np.testing.assert_allclose(a[2], 48 + 80 * 3 / np.sqrt(2) / (10 - 1 / np.sqrt(2)), rtol=1e-5)
    assert a[2] - a[0] < b[2] - b[0]
    assert a[3] - a[1] > b[3] - b[1]


def test_boxes_end_at_the_image_and_those_out_of_view_unknown_or_without_size_are_counted():
    things = [
        (pose(-6.0, 0.0, 10.0), xyz(4.0, 2.0, 0.1), 1),  # half outside to the left
        (pose(-30.0, 0.0, 10.0), xyz(4.0, 2.0, 0.1), 1),
        (pose(0.0, 0.0, -10.0), xyz(4.0, 2.0, 2.0), 1),  # behind
        (pose(0.0, 0.0, 10.0), xyz(0.0, 2.0, 2.0), 1),
        (pose(0.0, 0.0, 10.0), xyz(2.0, 2.0, 2.0), 0),  # unknown
        (pose(0.0, 0.0, 10.0, (0.0, 0.0, 0.0, 0.0)), xyz(2.0, 2.0, 2.0), 1),
    ]
    boxes, classes, _, dropped = read_detections_3d(autoware(*things), CAMERA, "camera_optical")
    assert (len(boxes), classes, dropped) == (1, ["car"], 5)
    assert boxes[0][0] == -0.5


def test_detection_3d_arrays_go_through_the_whole_stage_in_the_cameras_frame_only(kit, tmp_path, run_ingest):
    made = kit.Kit(frames=2).drive()
    for name, text in _3D.items():
        made.store.fielddefs.pop(name, None)
        made.store.register(get_types_from_msg(text, name))
    for i, frame in enumerate(("camera_optical", "base_link")):
        stamp = kit.START_NS + i * kit.PERIOD_NS + 1_000_000
        as_2d = made.detections(stamp, [(0.0, 0.0, 1.0, 1.0, "car", 0.9)]).detections[0]
        centre = made.new("geometry_msgs/msg/Pose", position=made.vector("Point", 0, 0, 10),
                          orientation=made.quaternion(1, 0, 0, 0))  # fmt: skip
        box = made.new("vision_msgs/msg/BoundingBox3D", center=centre, size=made.vector("Vector3", 2, 2, 0.1))
        header = made.header(stamp, frame)
        one = made.new("vision_msgs/msg/Detection3D", header=header, results=as_2d.results, bbox=box, id="")
        array = made.new("vision_msgs/msg/Detection3DArray", header=header, detections=[one])
        made.replaced(kit.DETECTIONS, i, array)
    result, frames = run_ingest(made.mcap(tmp_path / "a.mcap"))
    half = 80 / 9.95
    np.testing.assert_allclose(
        frames[0].detection_boxes_px, [[48 - half, 32 - half, 48 + half, 32 + half]], rtol=1e-5
    )
    assert frames[0].detection_classes == ["car"]
    assert frames[1].detection_boxes_px is None
    assert result.rejected["detections_damaged"] == 1
    assert "'base_link' can be projected only with the calibration" in result.reason

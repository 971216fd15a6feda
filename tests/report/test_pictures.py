"""The pictures: what is drawn where, on a made scene with one pole."""

from dataclasses import MISSING, fields, replace
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.core.sections import ReportConfig
from pipeline.report.motion_view import draw_motion
from pipeline.report.overlays import Extrinsics, Scene, Window, close_up, decode_image, front_view, whole_view
from pipeline.report.pictures import top_bitmap, top_view
from pipeline.report.reading import choose_frames, choose_windows, scene_of
from pipeline.report.residuals import MEASURES, boundary_distance_px, frame_residuals
from pipeline.rig.cameras import camera_of
from pipeline.rig.se3 import exp_se3, exp_so3, from_rotation_translation, inverse, transform_points
from schemas.calibrations import SENSORS
from schemas.frames import Frame
from schemas.observations import EDGE_LEFT, EDGE_RIGHT, STEP_RIGHT, Observation

WIDTH, HEIGHT, FOCAL = 700, 300, 600.0
T_CL = from_rotation_translation(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.0, -0.3, -0.2])
)
T_LR = from_rotation_translation(np.eye(3), np.array([2.0, 0.0, -1.0]))
GOOD = Extrinsics(T_CL, T_CL @ T_LR, T_LR)
POLE_Y_M, POLE_X_M = 1.5, 12.0


def _turned(yaw_deg):
    turn = exp_se3(np.array([0.0, np.radians(yaw_deg), 0.0, 0.0, 0.0, 0.0]))
    turn_radar = exp_se3(np.array([0.0, 0.0, np.radians(yaw_deg), 0.0, 0.0, 0.0]))
    return Extrinsics(turn @ T_CL, turn @ T_CL @ T_LR, turn_radar @ T_LR)


def _blank(row_type, **known):
    """A row with empty arrays wherever the scene says nothing."""
    values: dict[str, Any] = {}
    plain = {"int": 0, "float": 0.0, "str": "", "bool": False}
    for f in (f for f in fields(row_type) if f.default is MISSING):
        kind = str(f.type)
        values[f.name] = None if "None" in kind else plain.get(kind)
        if values[f.name] is None and kind == "np.ndarray":
            values[f.name] = np.zeros((0, 3) if "xyz" in f.name or "centre" in f.name else (0,), np.float32)
        elif kind.startswith("list"):
            values[f.name] = list(SENSORS) if f.name == "sensors" else []
    return row_type(**(values | {"priors": {}} | known))


def _scene():
    z = np.linspace(-1.5, 1.5, 25)
    half = 0.15
    sides = [np.stack([np.full(25, POLE_X_M), np.full(25, POLE_Y_M + s * half), z], 1) for s in (1, -1)]
    wall = np.stack(np.meshgrid([25.0], np.linspace(-12, 12, 120), np.linspace(-1, 3, 12)), -1).reshape(-1, 3)
    pole, sweep = np.concatenate(sides), np.concatenate([*sides, wall]).astype(np.float32)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    base = {
        "image_width_px": WIDTH, "image_height_px": HEIGHT, "camera_model": "plumb_bob", "camera_K": K,
        "camera_D": np.zeros(0), "log": "made",
    }  # fmt: skip
    u = camera_u(pole)
    labels = np.full((HEIGHT, WIDTH), 2, np.uint8)
    labels[:, round(u.min()) : round(u.max()) + 1] = 5
    radar = transform_points(inverse(T_LR), pole + [0.0, 0.0, 0.0]).astype(np.float32)
    frame = _blank(
        Frame, **base, image=cv2.imencode(".png", np.full((HEIGHT, WIDTH, 3), 128, np.uint8))[1].tobytes(),
        lidar_x_m=sweep[:, 0], lidar_y_m=sweep[:, 1], lidar_z_m=sweep[:, 2],
        radar_x_m=radar[:, 0], radar_y_m=radar[:, 1], radar_z_m=radar[:, 2],
    )  # fmt: skip
    observation = _blank(
        Observation, **base, labels_png=cv2.imencode(".png", labels)[1].tobytes(), label_scale=1.0,
        road_user_boxes_px=np.zeros((0, 4), np.float32), lidar_edge_xyz_m=pole.astype(np.float32),
        lidar_edge_side=np.repeat([EDGE_RIGHT, EDGE_LEFT], 25).astype(np.uint8), lidar_map_xyz_m=sweep,
        lidar_map_is_ground=np.zeros(len(sweep), np.uint8), radar_xyz_m=radar,
        radar_motion=np.zeros(len(radar), np.uint8), radar_cluster=np.full(len(radar), -1, np.int32),
        radar_track_xyz_m=transform_points(inverse(T_LR), np.array([[15.0, -2.0, -0.5]])).astype(np.float32),
    )  # fmt: skip
    return Scene(frame, observation)


def camera_u(points):
    seen = transform_points(T_CL, points)
    return FOCAL * seen[:, 0] / seen[:, 2] + WIDTH / 2


@pytest.fixture(scope="module")
def scene():
    """A grey image, a pole, a wall and one moving radar track on the right."""
    return _scene()


def test_each_half_of_the_front_view_shows_its_own_state(scene):
    both = front_view(scene, _turned(2.0), GOOD, ("prior", "calibrated"))
    good = front_view(scene, GOOD, GOOD, ("prior", "calibrated"))
    bad = front_view(scene, _turned(2.0), _turned(2.0), ("prior", "calibrated"))
    middle = both.shape[1] // 2
    np.testing.assert_array_equal(both[:, middle + 3 :], good[:, middle + 3 :])
    np.testing.assert_array_equal(both[:, : middle - 3], bad[:, : middle - 3])
    assert (good[:, : middle - 3] != bad[:, : middle - 3]).any()


def test_both_sides_of_the_front_view_show_the_same_middle_of_the_image(scene):
    states = GOOD, _turned(2.0)
    both, whole = front_view(scene, *states, ("", "")), [whole_view(scene, state, "") for state in states]
    middle, rows = both.shape[1] // 2, slice(60, both.shape[0] // 2)  # without labels and colour bar
    left, right = both[rows, : middle - 3], both[rows, middle + 3 :]
    quarter = middle // 2
    np.testing.assert_array_equal(left, whole[0][rows, quarter : quarter + middle - 3])
    np.testing.assert_array_equal(right, whole[1][rows, quarter + 3 : quarter + middle])
    assert (left[:, 3:] != right[:, : middle - 6]).any()
    assert len(np.unique(left)) > 10
    assert top_view(scene, GOOD, GOOD, ("before", "before")).count(">before<") == 1


def test_a_moving_track_is_a_white_cross_where_it_projects(scene):
    image = whole_view(scene, GOOD, "")
    scale = image.shape[1] / WIDTH
    seen = transform_points(T_CL, np.array([[15.0, -2.0, -0.5]]))[0]
    u, v = FOCAL * seen[0] / seen[2] + WIDTH / 2, FOCAL * seen[1] / seen[2] + HEIGHT / 2
    assert (image[round(v * scale), round(u * scale)] == 255).all()


def test_a_close_up_shows_a_fifth_of_a_degree(scene):
    window = Window((float(camera_u(np.array([[POLE_X_M, POLE_Y_M, 0.0]]))[0]), 150.0), (84, 60))
    pictures = [close_up(scene, state, window, 5).astype(int) for state in (GOOD, _turned(0.2))]
    assert pictures[0].shape == (300, 420, 3)
    columns = [np.flatnonzero(np.abs(p - p[0, 0])[200:].sum(axis=(0, 2)) > 0).mean() for p in pictures]
    assert abs(columns[1] - columns[0]) > 5  # 0.2 deg are 2 px of the image and 10 px here


def test_a_broken_image_is_grey_and_not_a_crash(scene):
    for content in (b"", b"no picture"):
        broken = Frame(**(vars(scene.frame) | {"image": content}))
        assert decode_image(broken).shape == (HEIGHT, WIDTH, 3)


def test_radar_from_above_lies_on_the_pole_only_when_calibrated(scene):
    def black_at_pole(state):
        bitmap = top_bitmap(scene, state, state)
        row, column = round((60 - POLE_X_M) * 16), round((30 - POLE_Y_M) * 16)
        return bool((bitmap[row - 4 : row + 5, column - 4 : column + 5].sum(axis=-1) < 60).any())

    assert black_at_pole(GOOD)
    assert not black_at_pole(_turned(6.0))
    drawn = top_view(scene, GOOD, GOOD, ("a", "b<c"))
    assert "<svg" in drawn
    assert "b<c" not in drawn
    high = "#{2:02x}{1:02x}{0:02x}".format(*top_bitmap(scene, GOOD, GOOD)[(60 - 25) * 16, 30 * 16])
    assert f'y="110" width="12" height="40" fill="{high}"' in drawn  # the wall's top in the scale: 4 m


def test_residuals_get_worse_when_a_sensor_is_turned(scene):
    good, bad = frame_residuals([scene.observation], (GOOD, _turned(3.0)))
    assert set(good) == set(MEASURES)
    assert good["camera_lidar"][0] > 90
    assert bad["camera_lidar"][0] < 20
    assert good["lidar_radar"][0] > 90 > bad["lidar_radar"][0]
    assert np.isnan(good["camera_radar"][0])  # no moving detections in a box: nothing to tell


def test_the_pole_is_chosen_as_a_window_and_empty_frames_as_none(scene):
    windows = choose_windows(scene.observation, T_CL, 3)
    assert len(windows) >= 1
    u = float(camera_u(np.array([[POLE_X_M, POLE_Y_M, 0.0]]))[0])
    assert abs(windows[0].centre_px[0] - u) < windows[0].size_px[0] / 2
    x0, y0 = windows[0].corner_px(WIDTH, HEIGHT)
    assert 0 <= x0 <= WIDTH - windows[0].size_px[0]
    assert 0 <= y0 <= HEIGHT - windows[0].size_px[1]
    empty = Observation(**(vars(scene.observation) | {"lidar_edge_xyz_m": np.zeros((0, 3), np.float32),
                                                      "lidar_edge_side": np.zeros(0, np.uint8)}))  # fmt: skip
    assert choose_windows(empty, T_CL, 3) == []
    assert choose_frames([empty, scene.observation, empty], T_CL, 1) == [1]
    assert choose_frames([], T_CL, 3) == []


def test_road_users_are_hidden_and_nothing_else():
    scene, rng = _scene(), np.random.default_rng(5)
    image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    labels = np.full((HEIGHT, WIDTH), 2, np.uint8)
    labels[100:160, 50:80] = 11  # a person
    box = np.array([[200.0, 120.0, 260.0, 160.0]], np.float32)  # a car that only the detector saw
    frame = replace(scene.frame, image=cv2.imencode(".png", image)[1].tobytes())
    png = cv2.imencode(".png", labels)[1].tobytes()
    observation = replace(scene.observation, labels_png=png, road_user_boxes_px=box)
    shown = decode_image(scene_of(frame, observation, ReportConfig()).frame)
    hidden = decode_image(scene_of(frame, observation, ReportConfig(road_users="hidden")).frame)
    np.testing.assert_array_equal(shown, image)
    for rows, columns in ((slice(100, 160), slice(50, 80)), (slice(120, 160), slice(200, 260))):
        assert len(np.unique(hidden[rows, columns].reshape(-1, 3), axis=0)) < 0.02 * image[rows, columns].size
    far = np.ones((HEIGHT, WIDTH), bool)
    far[90:170, 40:90] = far[110:170, 190:270] = False
    np.testing.assert_array_equal(hidden[far], image[far])


def test_what_is_no_picture_is_not_shown_where_road_users_are_hidden():
    scene = _scene()
    broken = replace(scene.frame, image=b"no picture")
    assert scene_of(broken, scene.observation, ReportConfig(road_users="hidden")).frame.image == b""


def test_a_picture_that_nobody_looked_for_road_users_in_is_hidden_whole():
    scene, rng = _scene(), np.random.default_rng(6)
    image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    frame = replace(scene.frame, image=cv2.imencode(".png", image)[1].tobytes())
    unlabelled = replace(scene.observation, steps_png=scene.observation.labels_png)
    hidden = decode_image(scene_of(frame, unlabelled, ReportConfig(road_users="hidden")).frame)
    assert len(np.unique(hidden.reshape(-1, 3), axis=0)) < 0.02 * image.size


def test_without_labels_distances_are_to_steps_of_brightness():
    scene = _scene()
    steps = np.zeros((HEIGHT, WIDTH), np.uint8)
    steps[:, 60] = STEP_RIGHT
    png = cv2.imencode(".png", steps)[1].tobytes()
    unlabelled = replace(scene.observation, steps_png=png, label_scale=1.0)
    distance = boundary_distance_px(unlabelled, (5,))
    assert (distance[:, 61] == 0).all()
    assert distance[50, 91] == pytest.approx(30.0, abs=2.0)


def test_the_way_of_a_camera_and_straight_ahead_are_marked_where_they_project(scene):
    turn, yaw = np.radians([0.0, 4.0, 0.0]), np.radians([0.0, 3.0, 0.0])
    travel_now = np.array([0.1, 0.05, 1.0]) / np.linalg.norm([0.1, 0.05, 1.0])
    seen = replace(
        scene.observation,
        motion_turn_rad=turn,
        motion_direction=exp_so3(turn / 2) @ travel_now,
        motion_tracks_px=np.array([[100, 200, 140, 220]], np.float32),
    )
    after = T_CL.copy()
    after[:3, :3] = exp_so3(yaw) @ T_CL[:3, :3]
    image = draw_motion(scene.frame, seen, T_CL, after)
    scale = image.shape[1] / WIDTH
    camera = camera_of(scene.frame).scaled(scale)
    expected = camera.project(np.stack([travel_now, T_CL[:3, 0], after[:3, 0]]))[0]
    for colour, at in zip([(60, 60, 255), (200, 200, 200), (255, 170, 60)], expected, strict=True):
        v, u = np.nonzero((image == np.array(colour, np.uint8)).all(-1))
        assert np.hypot((u.min() + u.max()) / 2 - at[0], (v.min() + v.max()) / 2 - at[1]) < 3
    v, u = np.nonzero((image == np.array((90, 220, 90), np.uint8)).all(-1))
    assert np.hypot(u.max() - 140 * scale, v.max() - 220 * scale) < 5

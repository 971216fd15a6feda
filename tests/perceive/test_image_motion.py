"""Motion of a camera from its tracks and from two images: known truth, any camera model, and what must be named."""

import cv2
import numpy as np
import pytest

from pipeline.perceive import image_motion
from pipeline.perceive.earlier_greys import EarlierGreys
from pipeline.perceive.image_motion import (
    MotionReason,
    NoMotionError,
    Tracks,
    _moved,
    _pixel_rad,
    _residuals,
    motion_of_tracks,
)
from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import exp_so3, log_so3
from schemas.captures import Image

SIZE = (900, 470)
K = np.array([[420.0, 0, 449.5], [0, 420.0, 234.5], [0, 0, 1]])
CAMERAS = {
    "pinhole": Camera("plumb_bob", K, np.zeros(0), *SIZE),
    "distorted": Camera("plumb_bob", K, np.array([-0.2, 0.05, 0.001, -0.001]), *SIZE),
    "f-theta": Camera("equidistant", K, np.zeros(4), *SIZE),
    "fisheye": Camera("equidistant", K * [[0.55], [0.55], [1]], np.array([-0.02, 0.002, 0, 0]), *SIZE),
}
STRAIGHT = np.radians([0.1, 0.3, -0.05])


def tracks_of(
    camera, turn=STRAIGHT, direction=(0.05, -0.02, 1.0), way_m=3.0, *, seed=0, noise_px=0.15, traffic=0.0, bonnet=0,
    readout=0.0,
):  # fmt: skip
    """Tracks of a static world, of road users, and of the car's own bonnet; true turn and direction midway.

    `readout` is of a rolling shutter, as a share of the time between both images.
    """
    rng = np.random.default_rng(seed)
    u = np.array(direction) / np.linalg.norm(direction)
    rays = camera.unproject(rng.uniform([0, 0], np.array(SIZE) - 1, (600, 2)))
    now = rays[np.isfinite(rays).all(1)] * rng.uniform(4, 60, (np.isfinite(rays).all(1).sum(), 1))
    R = exp_so3(np.array(turn))
    t = exp_so3(np.array(turn) / 2) @ u * way_m  # in axes of the earlier camera
    users = rng.random(len(now)) < traffic
    before = now @ R.T + t + users[:, None] * np.array([0.8, 0.0, 2.5])
    uv, uv_before = camera.project(now)[0], camera.project(before)[0]
    way = exp_so3(-np.array(turn) / 2) @ u * way_m  # in axes of the later camera
    for _ in range(3 if readout else 0):
        late, late_before = (((at[:, 1:] + 0.5) / SIZE[1] - 0.5) * readout for at in (uv, uv_before))
        uv = camera.project(now - late * (way + np.cross(turn, now)))[0]
        uv_before = camera.project(before - late_before * (R @ way + np.cross(turn, before)))[0]
    seen = camera.contains(uv) & camera.contains(uv_before) & camera.project(before)[1]
    uv, uv_before = uv[seen], uv_before[seen] + rng.normal(0, noise_px, (seen.sum(), 2))
    own = rng.uniform([200, 420], [700, 469], (bonnet, 2))
    uv, uv_before = (
        np.concatenate([uv, own]),
        np.concatenate([uv_before, own + rng.normal(0, 0.05, own.shape)]),
    )
    a, b = camera.unproject(uv_before), camera.unproject(uv)
    known = np.isfinite(a).all(1) & np.isfinite(b).all(1)
    return Tracks(uv_before, uv, a, b, _pixel_rad(b, camera)).some(known), np.array(turn), u


def errors(found, turn, u):
    """Errors of turn and direction [rad], in two axes across the direction."""
    across = np.linalg.svd(u[None])[2][1:]
    return np.concatenate([log_so3(exp_so3(-turn) @ exp_so3(found.turn)), across @ found.direction])


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("direction", [(0.05, -0.02, 1.0), (0.95, 0.0, 0.3), (0.0, 0.1, -1.0)])
def test_motion_comes_out_within_its_sigma_for_any_camera_and_way(name, direction):
    z = []
    for seed in range(12):
        tracks, turn, u = tracks_of(CAMERAS[name], direction=direction, seed=seed)
        found = motion_of_tracks(tracks, SIZE)
        across = np.linalg.svd(u[None])[2][1:]
        J = np.zeros((5, 6))
        J[:3, :3], J[3:, 3:] = np.eye(3), across
        e = errors(found, turn, u)
        assert np.abs(e).max() < np.radians(0.25)
        z.append(e @ np.linalg.inv(J @ found.covariance @ J.T) @ e / 5)
    assert 0.3 < np.mean(z) < 3.0


def test_a_rolling_shutter_is_no_motion():
    turn, off = np.radians([2.0, 5.0, -1.0]), {0.0: [], 0.1: []}
    for seed in range(8):
        tracks, turn, u = tracks_of(CAMERAS["pinhole"], turn=turn, seed=seed, readout=0.1)
        for readout, found in off.items():
            found.append(errors(motion_of_tracks(tracks, SIZE, readout), turn, u))
    as_if_at_once, known = (np.degrees(np.linalg.norm(np.mean(off[k], axis=0))) for k in off)
    assert known < 0.04
    assert as_if_at_once > 3 * known


@pytest.mark.parametrize("direction", [(0.05, -0.02, 1.0), (0.95, 0.0, 0.3)])
def test_residuals_have_the_derivative_of_a_step(direction):
    """With their size held, the direction of noisy tracks of a camera that looks aside is drawn outward."""
    tracks, turn, u = tracks_of(
        CAMERAS["pinhole"], turn=(0.02, 0.05, -0.01), direction=direction, noise_px=3.0
    )
    J = _residuals(tracks, turn, u)[1]
    steps = np.eye(5) * 1e-6
    ahead, back = (
        np.stack([_residuals(tracks, *_moved(turn, u, d))[0] for d in sign * steps]) for sign in (1, -1)
    )
    np.testing.assert_allclose((ahead - back).T / 2e-6, J, atol=1e-7)


@pytest.mark.parametrize("direction", [(0.05, -0.02, 1.0), (0.0, 0.1, -1.0)])
def test_a_known_turn_sharpens_the_direction_by_the_stated_correlation(direction):
    """Of a camera that looks ahead or back, an error of the turn about y is one of the direction along x."""
    alone, known = [], []
    for seed in range(40):
        tracks, turn, u = tracks_of(CAMERAS["pinhole"], direction=direction, seed=seed, way_m=1.0)
        found = motion_of_tracks(tracks, SIZE)
        by_turn = found.covariance[3, 1] / found.covariance[1, 1]
        alone.append((found.direction - u)[0])
        known.append(alone[-1] - by_turn * (found.turn - turn)[1])
    assert np.std(known) < 0.85 * np.std(alone)


def test_a_third_of_traffic_and_the_bonnet_move_it_little():
    for seed in range(5):
        clean, turn, u = tracks_of(CAMERAS["pinhole"], seed=seed)
        disturbed, *_ = tracks_of(CAMERAS["pinhole"], seed=seed, traffic=0.3, bonnet=150)
        assert np.abs(errors(motion_of_tracks(clean, SIZE), turn, u)).max() < np.radians(0.15)
        assert np.abs(errors(motion_of_tracks(disturbed, SIZE), turn, u)).max() < np.radians(0.25)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"way_m": 1e-4, "turn": np.zeros(3), "noise_px": 0.02}, MotionReason.STANDING),
        ({"way_m": 1e-3, "turn": np.radians([0.0, 4.0, 0.0])}, MotionReason.NO_PARALLAX),
    ],
)
def test_what_shows_no_motion_is_named(changes, reason):
    tracks, *_ = tracks_of(CAMERAS["pinhole"], **changes)
    with pytest.raises(NoMotionError) as err:
        motion_of_tracks(tracks, SIZE)
    assert err.value.reason == reason


def test_points_behind_the_camera_are_named():
    tracks, *_ = tracks_of(CAMERAS["pinhole"])
    half = np.arange(len(tracks.now)) % 2 == 0  # as if half the world went backwards: no depth is in front
    ends = [(tracks.before_px, tracks.now_px), (tracks.before, tracks.now)]
    swapped = [np.where(half[:, None], *two) for pair in ends for two in (pair, pair[::-1])]
    mixed = Tracks(*swapped, tracks.pixel_rad)
    with pytest.raises(NoMotionError) as err:
        motion_of_tracks(mixed, SIZE)
    assert err.value.reason in (MotionReason.BEHIND, MotionReason.NO_COMMON_MOTION)


CAMERA = CAMERAS["pinhole"]


def street(x_m, yaw_rad=0.0, brightness=1.0):
    """Grey picture of a textured road between two textured walls, of a camera 1.5 m up that looks ahead."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    rays = CAMERA.unproject(np.stack([u, v], -1).astype(float))  # x right, y down, z ahead
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    ahead, left, up = c * rays[..., 2] + s * rays[..., 0], s * rays[..., 2] - c * rays[..., 0], -rays[..., 1]
    with np.errstate(divide="ignore"):
        to_road = np.where(up < 0, 1.5 / -up, np.inf)
        to_wall = 6.0 / np.abs(left)
    near = np.minimum(np.minimum(to_road, to_wall), 80.0)
    at = np.stack([x_m + near * ahead, near * left, near * up], -1)
    is_road = to_road < to_wall
    cells = np.floor(np.stack([at[..., 0], np.where(is_road, at[..., 1], at[..., 2])], -1) / 0.6).astype(
        np.int64
    )
    shade = ((cells[..., 0] * 7919 + cells[..., 1] * 104729 + is_road * 31) ** 2 // 7) % 200
    grey = np.where(near >= 80.0, 220, shade + 20)
    return cv2.GaussianBlur((grey * brightness).astype(np.uint8), (0, 0), 1.0)


def image(stamp_s, earlier_s=None, *, kept=None, driven_m=None, missing=None):
    return Image(
        moment=0, stamp_ns=int(stamp_s * 1e9), image=b"", image_format="png", image_width_px=SIZE[0],
        image_height_px=SIZE[1], camera_model=CAMERA.model, camera_K=CAMERA.K, camera_D=CAMERA.D, labels_png=None,
        detection_boxes_px=None, detection_classes=None, detection_scores=None,
        earlier_stamp_ns=None if earlier_s is None else int(earlier_s * 1e9), earlier_image=kept,
        earlier_missing=missing, ego_driven_m=driven_m,
    )  # fmt: skip


def test_two_pictures_of_a_street_show_turn_and_direction():
    greys = EarlierGreys()
    first, reason = greys.columns(image(0.0, missing="no_earlier_image"), street(0.0), None, None)
    assert (first, reason) == ({}, MotionReason.NO_EARLIER)
    found, reason = greys.columns(image(0.3, 0.0), street(2.0, np.radians(1.0)), None, None)
    assert reason is None
    assert np.degrees(found["motion_turn_rad"]) == pytest.approx([0.0, -1.0, 0.0], abs=0.06)
    assert np.degrees(found["motion_direction"][:2]) == pytest.approx([0.5, 0.0], abs=0.25)
    assert found["motion_span_s"] == pytest.approx(0.3)
    # The same from the picture that ingest kept.
    kept = bytes(cv2.imencode(".jpg", street(0.0), (cv2.IMWRITE_JPEG_QUALITY, 92))[1])
    again, _ = EarlierGreys().columns(image(0.3, 0.0, kept=kept), street(2.0, np.radians(1.0)), None, None)
    assert again["motion_direction"] == pytest.approx(found["motion_direction"], abs=2e-3)


def sticker(seed):
    """Picture of something on the car itself, with noise."""
    cells = np.random.default_rng(5).integers(20, 220, (24, 45)).astype(np.uint8)
    noise = np.random.default_rng(seed).integers(0, 5, SIZE[::-1]).astype(np.uint8)
    return cv2.resize(cells, SIZE, interpolation=cv2.INTER_NEAREST) + noise


@pytest.mark.parametrize(
    ("pictures", "about", "reason"),
    [
        ((street(0.0), street(0.0)), {"driven_m": 3.0}, MotionReason.SAME_IMAGE),
        ((street(0.0), street(0.0)), {"driven_m": 0.0}, MotionReason.STANDING),
        ((sticker(1), sticker(2)), {"driven_m": 3.0}, MotionReason.STATIC_TRACKS),
        ((street(0.0), street(2.0, brightness=0.0)), {"driven_m": 2.0}, MotionReason.FEW_TRACKS),
        ((street(0.0), street(2.0)), {"earlier_s": 0.05}, MotionReason.NO_EARLIER),  # its moment was not perceived
        ((street(0.0), street(2.0)), {"earlier_s": None, "missing": "images_too_far_apart"}, MotionReason.TOO_FAR),
        ((street(0.0), street(2.0)), {"earlier_s": None, "missing": "stamps_jump"}, MotionReason.STAMPS_JUMP),
    ],
)  # fmt: skip
def test_bad_images_show_no_motion_and_are_named(pictures, about, reason):
    greys = EarlierGreys()
    greys.columns(image(0.0), pictures[0], None, None)
    assert greys.columns(image(0.3, **({"earlier_s": 0.0} | about)), pictures[1], None, None) == ({}, reason)


def test_a_mirrored_camera_turns_the_other_way():
    """In itself its motion is sound: `camera_base` names it by the car's yaw rate."""
    greys, yawed = EarlierGreys(), np.radians(1.0)
    greys.columns(image(0.0), np.ascontiguousarray(street(0.0)[:, ::-1]), None, None)
    found, _ = greys.columns(image(0.3, 0.0), np.ascontiguousarray(street(2.0, yawed)[:, ::-1]), None, None)
    assert np.degrees(found["motion_turn_rad"]) == pytest.approx([0.0, 1.0, 0.0], abs=0.06)


def test_an_image_costs_a_bounded_number_of_tracks_and_steps(monkeypatch):
    """Nearly all of its time: half of it to track two thousand times, a third for twelve passes over the tracks."""
    tracked, passes = [], []
    flow, residuals = cv2.calcOpticalFlowPyrLK, image_motion._residuals
    monkeypatch.setattr(
        cv2, "calcOpticalFlowPyrLK", lambda *a, **k: (tracked.append(len(a[2])), flow(*a, **k))[1]
    )
    monkeypatch.setattr(image_motion, "_residuals", lambda *a: (passes.append(1), residuals(*a))[1])
    greys = EarlierGreys()
    greys.columns(image(0.0), street(0.0), None, None)
    _, reason = greys.columns(image(0.3, 0.0), street(2.0), None, None)
    assert reason is None
    assert 500 < sum(tracked) <= 2000
    assert len(passes) <= 12


def test_corners_of_road_users_are_left_out():
    greys = EarlierGreys()
    greys.columns(image(0.0), street(0.0), None, None)
    labels = np.zeros(SIZE[::-1], np.uint8)
    labels[300:, :] = 13
    boxes = np.array([[0, 0, 300, 200]], np.float32)
    found, _ = greys.columns(image(0.3, 0.0), street(2.0), labels, boxes)
    u, v = found["motion_tracks_px"][:, 2:].T
    assert v.max() < 300
    assert not ((u < 295) & (v < 195)).any()

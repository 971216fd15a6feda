"""Rows of training data: angles are right to a tenth of a degree, and nothing leaks into the network's input."""

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from pipeline.learn.sample.clouds import range_edges
from pipeline.learn.sample.frame_sample import (
    About,
    Reference,
    SampleReason,
    SampleRejectedError,
    camera_features,
    fingerprint,
    make_row,
    sensor_row,
    stored_grid,
)
from pipeline.learn.sample.grid import grid_rays, resample_camera
from pipeline.learn.sample.rendering import lidar_features
from pipeline.rig.cameras import Camera
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import camera_direction_angles, transform_points
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT
from schemas.training import GRID_CLASSES, NO_EDGE, POINT_IS_GROUND
from tests.makers import solve_scenes, training_lakes

ABOUT = About("v", "2026-01-01", "default", "train", "p", "urban")
PRIOR = Prior(solve_scenes.T_CAMERA_LIDAR, solve_scenes.T_LIDAR_RADAR, 0.02, 0.05)
# f-theta, 0.06 deg per pixel
K = np.array([[955.0, 0, 799.5], [0, 955.0, 449.5], [0, 0, 1.0]])
FTHETA = Camera("equidistant", K, np.zeros(4), 1600, 900)
SKY, ROAD, CAR, BUILDING = 10, 0, 13, 2


def angles(grid):
    """Azimuth (left) and elevation (up) of the cells' centres [deg]."""
    return np.moveaxis(np.degrees(camera_direction_angles(grid_rays(grid))), -1, 0)


@lru_cache
def pixel_angles():
    v, u = np.mgrid[0 : FTHETA.height_px, 0 : FTHETA.width_px].astype(float)
    return np.moveaxis(np.degrees(camera_direction_angles(FTHETA.unproject(np.stack([u, v], -1)))), -1, 0)


def labels_by_angle(paint):
    """A full-size label image painted by azimuth and elevation [deg]."""
    return paint(*pixel_angles()).astype(np.uint8)


@pytest.mark.parametrize("step_deg", [0.2, 0.3, 0.4])
def test_distances_and_boundaries_are_angles_from_the_centre_of_the_cell(step_deg):
    grid = stored_grid((96, 160), step_deg)
    # a car from 5.03 deg to the left to 3.17 deg to the right, sky above 2.5 deg; the rest is road
    labels = labels_by_angle(
        lambda a, e: np.where((a < 5.03) & (a > -3.17) & (e < 1.0), CAR, np.where(e > 2.5, SKY, ROAD))
    )
    _, edge_offset = camera_features(labels, FTHETA, grid)
    azimuth, elevation = angles(grid)
    level = np.abs(elevation + 2) < 1  # near the horizon the grid's angles are the world's

    # Offsets are positive to the right, azimuth to the left. The car is the foreground: it lies right of its left end.
    for side, end in ((EDGE_RIGHT, 5.03), (EDGE_LEFT, -3.17)):
        offset = edge_offset[side]
        near = level & (np.abs(azimuth - end) < 6)
        assert np.abs(offset[near] * 0.05 - (azimuth - end)[near]).max() < 0.11
        assert abs(np.mean(offset[near] * 0.05 - (azimuth - end)[near])) < 0.05
        assert (offset[level & (np.abs(azimuth - end) > 6.6)] == NO_EDGE).all()

    middle = (np.abs(azimuth) < 1) & (np.abs(elevation - 1.0) < 0.7)  # above lies the sky's border
    below = edge_offset[EDGE_BELOW] * 0.05
    assert np.abs(below - (elevation - 1.0))[middle].max() < 0.11
    # Pixels make stairs of a side.
    upright = level & (np.abs(azimuth - 5.03) > 0.3) & (np.abs(azimuth + 3.17) > 0.3)
    assert (edge_offset[EDGE_ABOVE][upright] == NO_EDGE).all()


def test_cells_have_the_class_of_most_of_them_and_none_outside_the_image():
    grid = stored_grid((128, 304), 0.4)  # wider than the camera
    labels = labels_by_angle(lambda _, e: np.where(e > 1.1, BUILDING, ROAD))
    grid_class, _ = camera_features(labels, FTHETA, grid)
    azimuth, elevation = angles(grid)
    inside = resample_camera(np.zeros((*labels.shape, 3), np.uint8), FTHETA, grid)[1] == 1
    expected = np.where(elevation > 1.1, GRID_CLASSES.index("building"), GRID_CLASSES.index("road"))
    clear = inside & (np.abs(elevation - 1.1) > 0.2)
    assert (grid_class == expected)[clear].all()
    horizon = np.abs(elevation) < 1  # elsewhere an f-theta image has other borders than an azimuth
    assert not inside[horizon & (np.abs(azimuth) > 48.2)].any()
    assert inside[horizon & (np.abs(azimuth) < 47.5)].all()
    assert (grid_class[horizon & (np.abs(azimuth) > 48.4)] == 255).all()


def scene(seed=0, **changes):
    rng = np.random.default_rng(seed)
    observation = solve_scenes.make_observation(rng, 0, 0, 1.0, **changes)
    return training_lakes.frame_of(observation, rng), observation


def row_of(frame, observation):
    config = training_lakes.fleet_of(["v"]).prepare
    return make_row(frame, observation, Reference(PRIOR), ABOUT, config)


def test_lidar_points_fall_on_their_object_in_the_grid_and_boxes_around_it():
    row = row_of(*scene())
    grid = stored_grid((row.grid_height, row.grid_width), row.grid_step_deg)
    is_object = (row.lidar_flags & POINT_IS_GROUND) == 0
    points = row.lidar_xyz_m[: row.lidar_count][is_object[: row.lidar_count]].astype(float)
    seen_from = transform_points(solve_scenes.T_CAMERA_LIDAR, points)
    azimuth, elevation = np.degrees(camera_direction_angles(seen_from)).T
    column = np.floor((grid.left_deg - azimuth) / grid.cell_deg).astype(int)
    line = np.floor((grid.top_deg - elevation) / grid.cell_deg).astype(int)
    seen = (column >= 0) & (column < grid.width) & (line >= 0) & (line < grid.height)
    seen[seen] = row.grid_seen.reshape(grid.height, grid.width)[line[seen], column[seen]] == 1
    assert seen.sum() > 100
    azimuth, elevation, line, column = (x[seen] for x in (azimuth, elevation, line, column))
    shown = row.grid_class.reshape(grid.height, grid.width)[line, column]
    assert np.mean(shown == GRID_CLASSES.index("vehicle")) > 0.9
    boxes = np.degrees(row.detection_box_rad[: row.detection_count, :, None])
    left, top, right, bottom = boxes.transpose(1, 0, 2)
    margin = 0.3
    inside = (azimuth < left + margin) & (azimuth > right - margin)
    inside &= (elevation < top + margin) & (elevation > bottom - margin)
    assert np.mean(inside.any(axis=0)) > 0.97


def test_the_image_is_red_green_blue_and_lies_where_the_classes_lie():
    frame, observation = scene()
    labels = cv2.imdecode(np.frombuffer(observation.labels_png, np.uint8), cv2.IMREAD_GRAYSCALE)
    painted = np.zeros((*labels.shape, 3), np.uint8)
    painted[labels == CAR] = (0, 0, 255)  # blue, green, red
    painted = cv2.resize(painted, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    png = cv2.imencode(".png", painted)[1].tobytes()
    row = row_of(replace(frame, image=png, image_format="png"), observation)
    red, green, blue = row.image.astype(float)
    car = row.grid_class == GRID_CLASSES.index("vehicle")
    assert car.sum() > 50
    assert np.mean(red[car] > 127) > 0.95
    assert np.mean(red[(row.grid_seen == 1) & ~car] > 127) < 0.02
    assert green.max() == blue.max() == 0


def test_no_semantics_of_the_camera_reach_the_lidar_points_of_the_input():
    frame, observation = scene()
    other = scene(seed=5)[1]
    blind = replace(
        observation,
        labels_png=other.labels_png,
        road_user_boxes_px=other.road_user_boxes_px,
        lidar_map_cluster=np.full_like(observation.lidar_map_cluster, -1),
    )
    a, b = row_of(frame, observation), row_of(frame, blind)
    assert not np.array_equal(a.grid_class, b.grid_class)
    for name in ("lidar_xyz_m", "lidar_intensity", "lidar_flags"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    flags = a.lidar_flags[: a.lidar_count]
    assert set(np.unique(flags & POINT_IS_GROUND)) == {0, POINT_IS_GROUND}
    assert np.array_equal(lidar_features(a)[:, 3], (flags & POINT_IS_GROUND) > 0)  # as LIDAR_FEATURES has it


def test_a_network_is_asked_with_the_same_numbers_that_it_was_taught_with():
    frame, observation = scene()
    taught = row_of(frame, observation)
    config = training_lakes.fleet_of(["v"]).prepare
    asked = sensor_row(frame, observation, PRIOR, ABOUT, config)
    semantic = {"grid_class", "edge_offset"}
    for name in taught.__dataclass_fields__:
        same = np.array_equal(getattr(asked, name), getattr(taught, name))
        assert same is not (name in semantic or name.startswith("detection_")), name
        if not same:
            assert not np.any(getattr(asked, name)), name


def test_range_edges_are_the_near_ends_of_jumps():
    azimuth = np.radians(np.arange(-20, 20, 0.2))
    distance = np.where(np.abs(np.degrees(azimuth) - 2) < 5, 10.0, 30.0)
    ring = np.repeat([0, 1], len(azimuth))
    xyz = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), np.zeros_like(azimuth)], -1)
    xyz = np.concatenate([xyz, xyz + [0, 0, 0.2]]).astype(np.float32)
    shuffled = np.random.default_rng(0).permutation(len(xyz))
    edge = np.zeros(len(xyz), bool)
    edge[shuffled] = range_edges(xyz[shuffled], ring[shuffled])
    near = np.degrees(np.arctan2(xyz[edge, 1], xyz[edge, 0]))
    assert sorted(np.round(near, 1)) == pytest.approx([-2.9, -2.9, 6.9, 6.9], abs=0.21)
    assert not range_edges(np.full((5, 3), np.nan, np.float32), None).any()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"image": b"\xff\xd8 no image"}, SampleReason.UNDECODABLE_IMAGE),
        ({"image": b""}, SampleReason.UNDECODABLE_IMAGE),
        ({"lidar_x_m": np.full(780, -5, np.float32)}, SampleReason.FEW_LIDAR_POINTS),
    ],
)
def test_a_frame_that_shows_too_little_is_left_out_with_its_reason(changes, reason):
    frame, observation = scene()
    with pytest.raises(SampleRejectedError) as rejected:
        row_of(replace(frame, **changes), observation)
    assert rejected.value.reason == reason


def test_fingerprints_are_near_for_the_same_view_and_far_for_others():
    rng = np.random.default_rng(3)
    views = [cv2.resize(rng.integers(0, 255, (9, 12, 3)).astype(np.uint8), (224, 128)) for _ in range(8)]
    noisy = [np.clip(v + rng.normal(0, 4, v.shape), 0, 255).astype(np.uint8) for v in views]
    bits = np.unpackbits(np.stack([fingerprint(v) for v in views + noisy]), axis=1)
    differing = (bits[:, None] != bits[None]).sum(-1)
    same = differing[np.arange(8), np.arange(8) + 8]
    others = differing[:8, :8][~np.eye(8, dtype=bool)]
    assert same.max() < 16
    assert others.min() > 60


@pytest.mark.parametrize("deskewed", [False, True])
def test_a_sweep_is_shown_at_its_stamp_with_the_ground_that_perception_found(deskewed):
    frame, observation = scene()
    time_s = np.linspace(-0.1, 0.0, len(frame.lidar_x_m), dtype=np.float32)
    x_m = frame.lidar_x_m - (0.0 if deskewed else 12.0) * time_s  # of a car that drives at 12 m/s
    seen = replace(frame, lidar_time_s=time_s, lidar_deskewed=deskewed, lidar_x_m=x_m)
    moving = {"ego_speed_mps": 12.0, "radar_velocity_mps": None, "lidar_map_time_s": time_s}
    row = row_of(seen, replace(observation, **moving))
    still = row_of(frame, observation)
    np.testing.assert_allclose(row.lidar_xyz_m, still.lidar_xyz_m, atol=1e-4)
    assert np.array_equal(row.lidar_flags & POINT_IS_GROUND, still.lidar_flags & POINT_IS_GROUND)

"""The grid's angles, and what is rendered onto it through a guess."""

import numpy as np
import pytest

from pipeline.learn.sample.grid import Grid, grid_rays, resample_camera
from pipeline.learn.sample.rendering import NEARNESS_M, nearest_points, painted
from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import camera_direction_angles

GRID = Grid()
WIDE = np.array([[900.0, 0, 911.5], [0, 920, 469.5], [0, 0, 1]])
NARROW = np.array([[450.0, 0, 399.5], [0, 450, 224.5], [0, 0, 1]])
CAMERAS = {
    "f-theta": Camera("equidistant", WIDE, np.zeros(4), 1824, 940),
    "pinhole": Camera("plumb_bob", NARROW, np.array([-0.05, 0.01, 0.001, 0, 0]), 800, 450),
}


def cells(points):
    return nearest_points(np.asarray(points, np.float32), GRID)


def test_cells_look_where_their_row_and_column_say():
    angles = np.degrees(camera_direction_angles(grid_rays(GRID)))
    assert angles[0, 0] == pytest.approx([38.2, 15.8])
    assert angles[-1, -1] == pytest.approx([-38.2, -22.2])
    assert np.diff(angles[50, :, 0]) == pytest.approx(-0.4)


def test_a_point_on_the_ray_of_each_cell_is_rendered_into_that_cell():
    rays = grid_rays(GRID).reshape(-1, 3)
    points = (rays * np.linspace(6, 90, len(rays))[:, None]).astype(np.float32)
    np.testing.assert_array_equal(cells(points), np.arange(len(rays)))
    image, _ = painted(points, np.tile(np.arange(3, dtype=np.float32), (len(points), 1)), GRID)
    near = np.minimum(NEARNESS_M / np.linalg.norm(points, axis=1), 2)
    assert image[1].ravel() == pytest.approx(near, rel=1e-5)
    np.testing.assert_array_equal(image[[0, 2, 3, 4]].mean(axis=(1, 2)), [1, 0, 1, 2])


def test_what_is_behind_or_outside_is_not_rendered():
    assert (cells([[0, 0, -10], [30, 0, 10], [0, -10, 10], [0, 10, 10], [0, 0, 0.2]]) == -1).all()


@pytest.mark.parametrize("model", CAMERAS)
def test_cameras_of_any_lens_show_each_direction_in_its_cell(model):
    camera = CAMERAS[model]
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    angles = np.degrees(camera_direction_angles(camera.unproject(np.stack([u, v], -1))))
    cells = np.degrees(np.stack(np.meshgrid(GRID.azimuth_rad(), GRID.elevation_rad()), -1))
    for axis in (0, 1):
        # Three levels per degree, and the mirror image: together they cancel what rounding to whole levels adds.
        colours = np.stack([angles[..., axis], -angles[..., axis], np.zeros_like(u)], -1) * 3 + 127
        image = np.rint(np.clip(np.nan_to_num(colours), 0, 255)).astype(np.uint8)
        resampled, seen = resample_camera(image, camera, GRID)
        inside = seen == 1
        assert inside.mean() > 0.9
        one, other = np.moveaxis((resampled[..., :2].astype(float) - 127) / 3, -1, 0)
        assert np.abs(one - cells[..., axis])[inside].max() < 0.5  # three roundings
        assert abs(((one - other) / 2 - cells[..., axis])[inside].mean()) < 0.01


def test_the_networks_view_is_cut_out_of_larger_maps_and_refused_from_others():
    rows, columns = GRID.window((128, 224), 0.4)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (24, 120, 16, 208)
    for shape, step, words in (
        ((128, 224), 0.2, "deg"),
        ((90, 224), 0.4, "contain"),
        ((129, 224), 0.4, "between"),
    ):
        with pytest.raises(ValueError, match=words):
            GRID.window(shape, step)

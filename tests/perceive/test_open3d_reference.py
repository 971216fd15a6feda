"""Voxels and cast rays against open3d's, where the extra [view] is installed."""

import numpy as np
import pytest

from pipeline.perceive.lidar import sample_uniformly
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive

try:
    import open3d
except (ImportError, OSError) as err:  # OSError: one of the system's libraries that it loads is missing
    pytest.skip(f"needs the extra [view]: open3d is the reference ({err})", allow_module_level=True)


def test_voxels_hold_the_points_that_open3d_puts_into_them():
    """Ours keeps the point nearest to the mean that open3d gives; cells begin at multiples of the voxel."""
    rng, voxel_m = np.random.default_rng(0), 0.5
    blobs = [rng.normal(rng.uniform(-30, 30, 3), rng.uniform(0.1, 0.6), (60, 3)) for _ in range(25)]
    points = np.concatenate([*blobs, rng.uniform(-30, 30, (300, 3))])
    points = points[np.linalg.norm(points, axis=1) > 5.0].astype(np.float32)  # the own vehicle is left out
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(float)))
    bound = np.full(3, 64.0)
    means, _, rows = cloud.voxel_down_sample_and_trace(voxel_m, -bound, bound)
    nearest = [
        inside[np.linalg.norm(points[inside] - mean, axis=1).argmin()]
        for mean, inside in zip(np.asarray(means.points), map(np.asarray, rows), strict=True)
    ]
    assert sum(len(inside) >= 3 for inside in rows) > 50
    np.testing.assert_array_equal(sample_uniformly(points, voxel_m), np.sort(nearest))


def test_rays_end_where_open3d_s_end():
    """All around from 2 m above the road: static world and traffic, the same hits to a millimetre."""
    drive = Drive(5, "urban", 8.0, 0, False)
    moment = World(drive).moment(1.0)
    eye = drive.road.to_map(np.array([[drive.ego.arc(1.0), 0.0, 2.0]]))[0] - moment.standing.origin
    rays = np.random.default_rng(0).normal(0, [1, 1, 0.15], (20_000, 3)).astype(np.float32)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origins = np.broadcast_to(eye.astype(np.float32), rays.shape)
    ours = moment.cast(origins, rays, np.zeros(len(rays)))
    scene = open3d.t.geometry.RaycastingScene()
    corners = np.ascontiguousarray(moment.mesh.corners.reshape(-1, 3), np.float32)
    scene.add_triangles(corners, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3))
    theirs = scene.cast_rays(np.hstack([origins, rays]))
    hit = ours.triangle >= 0
    assert 0.5 < hit.mean() < 0.95
    assert (ours.triangle >= len(moment.standing.mesh)).sum() > 500  # road users
    np.testing.assert_array_equal(theirs["primitive_ids"].numpy()[hit], ours.triangle[hit])
    np.testing.assert_allclose(theirs["t_hit"].numpy(), ours.range_m, atol=1e-3)  # infinite without a hit

"""Clusters, planes, voxels and cast rays against open3d's, where the extra [view] is installed."""

import numpy as np
import pytest

from pipeline.perceive.dbscan import dbscan
from pipeline.perceive.ground import find_ground
from pipeline.perceive.lidar import sample_uniformly
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive

try:
    import open3d
except (ImportError, OSError) as err:  # OSError: one of the system's libraries that it loads is missing
    pytest.skip(f"needs the extra [view]: open3d is the reference ({err})", allow_module_level=True)


def cloud(points):
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))


def scattered(rng):
    """Dense blobs of several sizes in thin noise."""
    blobs = [
        c + rng.normal(0, s, (n, 3))
        for c, s, n in zip(
            rng.uniform(-30, 30, (25, 3)), rng.uniform(0.1, 0.6, 25), rng.integers(5, 80, 25), strict=True
        )
    ]
    return np.concatenate([*blobs, rng.uniform(-30, 30, (300, 3))])


@pytest.mark.parametrize("seed", range(3))
def test_clusters_are_those_of_open3d(seed):
    """The same noise, and cores together and apart alike; a border point between clusters is anybody's."""
    points, eps, least = scattered(np.random.default_rng(seed)), 0.7, 6
    ours, theirs = dbscan(points, eps, least), np.asarray(cloud(points).cluster_dbscan(eps, least))
    np.testing.assert_array_equal(ours == -1, theirs == -1)
    near = np.linalg.norm(points[:, None] - points, axis=-1) <= eps
    core = near.sum(axis=1) >= least
    pairs = set(zip(ours[core].tolist(), theirs[core].tolist(), strict=True))
    assert len(pairs) == len(set(ours[core])) == len(set(theirs[core])) > 5


@pytest.mark.parametrize("seed", range(3))
def test_the_road_is_the_plane_of_open3d(seed):
    """A tilted road with walls beside it: both find it within .1 deg and 3 cm at the car."""
    rng = np.random.default_rng(seed)
    road = np.column_stack([rng.uniform(3, 40, 4000), rng.uniform(-8, 8, 4000), np.zeros(4000)])
    road[:, 2] = -1.8 + 0.02 * road[:, 0] - 0.01 * road[:, 1] + rng.normal(0, 0.01, 4000)
    walls = np.column_stack(
        [rng.uniform(3, 40, 1500), rng.choice([-9.0, 9.0], 1500), rng.uniform(-1, 4, 1500)]
    )
    points = np.concatenate([road, walls]).astype(np.float32)
    found = find_ground(points, 0.15, np.random.default_rng(1))
    theirs, _ = cloud(points.astype(float)).segment_plane(0.05, 3, 1000)
    theirs = np.asarray(theirs) * np.sign(theirs[2])
    assert found.plane is not None
    assert np.degrees(np.arccos(min(1.0, found.plane[:3] @ theirs[:3]))) < 0.1
    assert abs(found.plane[3] - theirs[3]) < 0.03


@pytest.mark.parametrize("seed", range(3))
def test_voxels_hold_the_points_that_open3d_puts_into_them(seed):
    """Ours keeps the point nearest to the mean that open3d gives; cells begin at multiples of the voxel."""
    points, voxel_m = scattered(np.random.default_rng(seed)), 0.5
    points = points[np.linalg.norm(points, axis=1) > 5.0].astype(np.float32)  # the own vehicle is left out
    bound = np.full(3, 64.0)
    means, _, rows = cloud(points.astype(float)).voxel_down_sample_and_trace(voxel_m, -bound, bound)
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
    np.testing.assert_allclose(
        theirs["t_hit"].numpy(), ours.range_m, atol=1e-3
    )  # infinite where there is no hit

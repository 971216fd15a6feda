"""Cast rays against open3d's, where the extra [view] is installed."""

import numpy as np
import pytest

from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive

try:
    import open3d
except (ImportError, OSError) as err:  # OSError: one of the system's libraries that it loads is missing
    pytest.skip(f"needs the extra [view]: open3d is the reference ({err})", allow_module_level=True)


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

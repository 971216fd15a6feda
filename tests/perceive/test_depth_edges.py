"""Depth jumps of a wall with a post in front: which side, how sharp, and what must not become an edge."""

import numpy as np
import pytest

from pipeline.config import PerceiveConfig
from pipeline.geometry.spherical import from_spherical, to_spherical
from pipeline.perceive.depth_edges import lidar_edges
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT

CONFIG = PerceiveConfig()


def post_before_wall(step_deg=0.2, elevations_deg=(-3.0, -1.0, 1.0, 3.0), post_top_deg=0.0):
    """Post from -2 to 2 deg of azimuth at 10 m, below `post_top_deg`; wall at 30 m."""
    azimuth = np.radians(np.arange(-10, 10 + 1e-9, step_deg))
    e, a = np.meshgrid(np.radians(elevations_deg), azimuth, indexing="ij")
    post = (np.abs(a) < np.radians(2.05)) & (e < np.radians(post_top_deg))
    xyz = from_spherical(np.stack([a, e, np.where(post, 10.0, 30.0)], -1)).reshape(-1, 3).astype(np.float32)
    ring = np.repeat(np.arange(len(elevations_deg)), len(azimuth)).astype(np.uint16)
    return xyz, ring, np.where(post, 0, -1).ravel().astype(np.int32)


@pytest.mark.parametrize("with_ring", [True, False])
def test_sides_ranges_and_directions_of_a_post(with_ring):
    xyz, ring, cluster = post_before_wall()
    edges = lidar_edges(xyz, ring if with_ring else None, cluster, CONFIG)
    aer = to_spherical(edges.xyz_m.astype(float))
    assert np.bincount(edges.side, minlength=4)[[EDGE_LEFT, EDGE_RIGHT, EDGE_ABOVE]].tolist() == [2, 2, 0]
    # Left in the image is a larger azimuth; the post ends between the beams at 2.0 and 2.2 deg.
    np.testing.assert_allclose(np.degrees(aer[edges.side == EDGE_RIGHT, 0]), 2.1, atol=0.01)
    np.testing.assert_allclose(np.degrees(aer[edges.side == EDGE_LEFT, 0]), -2.1, atol=0.01)
    np.testing.assert_allclose(np.degrees(aer[edges.side == EDGE_BELOW, 1]), 0.0, atol=0.01)
    np.testing.assert_allclose(np.degrees(edges.gap_rad[edges.side == EDGE_BELOW]), 2.0, atol=0.01)
    np.testing.assert_allclose(aer[:, 2], 10.0, atol=1e-3)
    np.testing.assert_allclose(edges.jump_m, 20.0, atol=1e-3)
    assert (edges.points == np.count_nonzero(cluster == 0)).all()


def test_edges_do_not_depend_on_the_order_of_points_or_the_numbering_of_rings():
    xyz, ring, cluster = post_before_wall()
    shuffled = np.random.default_rng(0).permutation(len(xyz))
    renumbered = np.array([2, 0, 3, 1], np.uint16)[ring]
    a, b = (
        lidar_edges(xyz, ring, cluster, CONFIG),
        lidar_edges(xyz[shuffled], renumbered[shuffled], cluster[shuffled], CONFIG),
    )
    assert sorted(map(tuple, a.xyz_m.round(3))) == sorted(map(tuple, b.xyz_m.round(3)))


def test_many_missing_returns_make_no_edge_and_one_makes_a_wider_gap():
    xyz, ring, cluster = post_before_wall(elevations_deg=(-1.0,))
    azimuth = np.degrees(to_spherical(xyz.astype(float))[:, 0])
    one = ~np.isclose(azimuth, 2.2, atol=0.01)
    edges = lidar_edges(xyz[one], ring[one], cluster[one], CONFIG)
    assert np.degrees(edges.gap_rad[edges.side == EDGE_RIGHT]) == pytest.approx([0.4], abs=0.01)
    many = ~((azimuth > 2.1) & (azimuth < 3.1))
    assert not (lidar_edges(xyz[many], ring[many], cluster[many], CONFIG).side == EDGE_RIGHT).any()


def test_a_point_between_two_surfaces_adds_no_second_edge():
    xyz, ring, cluster = post_before_wall(elevations_deg=(-1.0,))
    azimuth = np.degrees(to_spherical(xyz.astype(float))[:, 0])
    mixed = np.isclose(azimuth, 2.2, atol=0.01)
    xyz[mixed] *= 20.0 / 30.0
    edges = lidar_edges(xyz, ring, cluster, CONFIG)
    assert np.count_nonzero(edges.side == EDGE_RIGHT) == 1
    assert to_spherical(edges.xyz_m[edges.side == EDGE_RIGHT].astype(float))[0, 2] == pytest.approx(
        10.0, abs=1e-3
    )


def test_empty_and_tiny_clouds_have_no_edges():
    for n in (0, 1):
        edges = lidar_edges(np.zeros((n, 3), np.float32), None, np.full(n, -1, np.int32), CONFIG)
        assert len(edges.side) == 0
        assert edges.xyz_m.shape == (0, 3)

"""Depth jumps of a wall with a post in front: which side, how sharp, and what must not become an edge."""

import numpy as np
import pytest

from pipeline.core.config import PerceiveConfig
from pipeline.perceive.depth_edges import lidar_edges
from pipeline.rig.se3 import from_spherical, to_spherical
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


@pytest.mark.parametrize("logged", ["rings", "no rings", "shuffled and renumbered"])
def test_sides_ranges_and_directions_of_a_post(logged):
    xyz, ring, cluster = post_before_wall()
    if logged == "no rings":
        ring = None
    elif logged != "rings":
        order = np.random.default_rng(0).permutation(len(xyz))
        xyz, ring, cluster = xyz[order], np.array([2, 0, 3, 1], np.uint16)[ring[order]], cluster[order]
    edges = lidar_edges(xyz, ring, cluster, CONFIG)
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


@pytest.mark.parametrize(
    ("gone_deg", "between_deg", "gaps_deg"),
    [((2.1, 2.3), None, [0.4]), ((2.1, 3.1), None, []), (None, 2.2, [0.2])],
    ids=["one return missing", "many returns missing", "a point between two surfaces"],
)
def test_missing_and_mixed_returns_at_a_border(gone_deg, between_deg, gaps_deg):
    xyz, ring, cluster = post_before_wall(elevations_deg=(-1.0,))
    azimuth = np.degrees(to_spherical(xyz.astype(float))[:, 0])
    if between_deg:
        xyz[np.isclose(azimuth, between_deg, atol=0.01)] *= 20.0 / 30.0
    kept = ~((azimuth > gone_deg[0]) & (azimuth < gone_deg[1])) if gone_deg else np.full(len(xyz), True)
    edges = lidar_edges(xyz[kept], ring[kept], cluster[kept], CONFIG)
    right = edges.side == EDGE_RIGHT
    assert np.degrees(edges.gap_rad[right]) == pytest.approx(gaps_deg, abs=0.01)
    np.testing.assert_allclose(to_spherical(edges.xyz_m[right].astype(float))[:, 2], 10.0, atol=1e-3)


def scattered(range_of, seed=0, points=24000):
    """A sweep of 40 x 20 deg in no order at all, and which of six lasers drew each point."""
    rng = np.random.default_rng(seed)
    a, e = np.radians(rng.uniform(-20, 20, points)), np.radians(rng.uniform(-12, 8, points))
    xyz = from_spherical(np.stack([a, e, range_of(a, e)], -1)).astype(np.float32)
    return xyz, np.degrees(a), np.degrees(e), rng.integers(0, 6, points).astype(np.uint16)


def is_post(azimuth_deg, elevation_deg):
    return (np.abs(azimuth_deg) < 2.0) & (elevation_deg < 3.0)


LOGGED = {"no ring": lambda _: None, "lasers as rings": lambda laser: laser, "ring 0 for all": np.zeros_like}


@pytest.mark.parametrize("logged", LOGGED)
def test_a_sweep_without_rows_shows_the_outline_of_a_post_where_it_is(logged):
    xyz, a, e, laser = scattered(lambda a, e: np.where(is_post(np.degrees(a), np.degrees(e)), 10.0, 30.0))
    cluster = np.where(is_post(a, e), 0, -1).astype(np.int32)
    edges = lidar_edges(xyz, LOGGED[logged](laser), cluster, CONFIG)
    assert not edges.has_rows
    aer = to_spherical(edges.xyz_m.astype(float))
    azimuth, elevation, gap = np.degrees(aer[:, 0]), np.degrees(aer[:, 1]), np.degrees(edges.gap_rad)
    off = {EDGE_RIGHT: azimuth - 2.0, EDGE_LEFT: azimuth + 2.0, EDGE_BELOW: elevation - 3.0}
    for side, distance in off.items():
        mine = edges.side == side
        assert mine.sum() > 15
        # The silhouette lies between the two beams: within half the gap of their middle, and gaps are small. At the
        # post's corner a neighbour above lies beyond its side.
        assert np.mean(np.abs(distance[mine]) <= gap[mine] / 2 + 1e-6) > 0.9
        assert abs(np.median(distance[mine])) < 0.05
        assert np.median(gap[mine]) < 0.4
    assert (edges.side == EDGE_ABOVE).sum() <= 2  # the post stands on the lower border
    np.testing.assert_allclose(aer[:, 2], 10.0, atol=1e-3)
    np.testing.assert_allclose(edges.jump_m, 20.0, atol=1e-3)


@pytest.mark.parametrize("logged", LOGGED)
def test_the_road_under_a_sweep_without_rows_has_no_edges(logged):
    xyz, a, _, laser = scattered(lambda _, e: np.where(e < -0.02, 1.8 / np.sin(np.maximum(-e, 0.02)), 90.0))
    edges = lidar_edges(xyz, LOGGED[logged](laser), np.full(len(a), -1, np.int32), CONFIG)
    assert len(edges.side) == 0

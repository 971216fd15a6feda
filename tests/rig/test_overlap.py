"""Edges of a van: a sensor looks where its mounting turns it, and shares what its neighbours see."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.rig.graph import BASE, Sensor
from pipeline.rig.overlap import find_edges, overlaps_of
from pipeline.rig.prior import RigPrior, star_of
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse, to_spherical

# Name, kind, azimuth that it looks to, half-width and half-height of its view [deg].
VAN = [
    ("front", "camera", 0, 35, 20), ("tele", "camera", 0, 12, 8), ("left", "camera", 90, 35, 20),
    ("right", "camera", -90, 35, 20), ("rear", "camera", 180, 35, 20),
    ("top", "lidar", 0, 180, 15), ("nose", "lidar", 0, 60, 10),
    ("ahead", "radar", 0, 50, 90), ("fl", "radar", 60, 50, 90), ("rr", "radar", -130, 50, 90),
]  # fmt: skip


def rig(sensors=VAN, sigma_deg=0.1):
    """Prior and views of sensors about a metre from the vehicle's origin."""
    nodes = tuple(Sensor(name, kind) for name, kind, *_ in sensors)
    T = {
        name: from_rotation_translation(exp_so3(np.radians([0, 0, yaw])), np.radians([yaw / 2, 10 * i, 60]))
        for i, (name, _, yaw, *_) in enumerate(sensors)
    }
    star = star_of(nodes, lambda a, b: inverse(T[a]) @ T[b])
    reference = next((n for n in nodes if n.kind == "lidar"), nodes[0])
    prior = RigPrior(nodes, reference, star, {n.name: (np.radians(sigma_deg), 0.01) for n in nodes})
    return prior, {name: window(*sides) for name, _, _, *sides in sensors}


def window(half_width_deg, half_height_deg):
    def seen(points):
        azimuth, elevation, _ = np.degrees(np.moveaxis(to_spherical(points), -1, 0))
        return (np.abs(azimuth) <= half_width_deg) & (np.abs(elevation) <= half_height_deg)

    return seen


def edges_of(prior, views, **given):
    return {e.name for e in find_edges(prior, overlaps_of(prior, views), **given).edges}


def test_the_share_is_of_the_one_that_sees_fewer_whichever_stands_first():
    wide = [("a", "camera", 0, 40, 20), ("b", "lidar", 0, 20, 10)]
    narrow = [("a", "camera", 0, 20, 10), ("b", "lidar", 0, 40, 20)]
    for sensors in (wide, narrow):
        (found,) = overlaps_of(*rig(sensors))
        assert found.share == pytest.approx(1.0, abs=0.05)
        assert found.shared_sr == pytest.approx(np.radians(40) * 2 * np.sin(np.radians(10)), rel=0.1)
    (half,) = overlaps_of(*rig([("a", "camera", 20, 20, 10), ("b", "lidar", 0, 20, 10)]))
    assert half.share == pytest.approx(0.5, abs=0.07)
    (none,) = overlaps_of(*rig([("a", "camera", 90, 20, 10), ("b", "lidar", 0, 20, 10)]))
    assert not none.is_enough


@pytest.mark.parametrize("wider", ["a", "b"])
def test_directions_are_carried_from_the_one_that_sees_fewer_to_the_other(wider):
    prior, _ = rig([("a", "camera", 40, 1, 1), ("b", "lidar", 0, 1, 1)])
    more = {"a": 0.0, "b": 0.0} | {wider: 2.0}

    def between(low, high, more):
        def seen(points):
            azimuth, elevation, _ = np.degrees(np.moveaxis(to_spherical(points), -1, 0))
            return (azimuth > low - more) & (azimuth < high + more) & (np.abs(elevation) < 10 + more)

        return seen

    # Both see 50 to 90 deg of the vehicle.
    views = {"a": between(10, 50, more["a"]), "b": between(50, 90, more["b"])}
    (found,) = overlaps_of(prior, views)
    assert found.share > 0.9


def test_each_camera_meets_the_lidar_all_around_and_only_the_radars_of_its_side():
    found = edges_of(*rig())
    assert {f"{camera}-top" for camera in ("front", "left", "right", "rear")} <= found
    assert {"front-ahead", "left-fl"} <= found
    assert not {"left-ahead", "right-fl", "rear-nose", "front-rr"} & found
    assert not {name for name in found if "front-left" in name or name in ("ahead-fl", "fl-rr")}


def test_a_sensor_keeps_its_three_best_edges_but_is_a_partner_of_others():
    many = [(f"c{i}", "camera", 0, 20 + i, 15) for i in range(4)] + [
        (f"l{i}", "lidar", 0, 60, 15) for i in range(5)
    ]
    prior, views = rig(many)
    graph = find_edges(prior, overlaps_of(prior, views))
    assert all(len(graph.edges_of(c)) >= 3 for c in graph.of_kind("camera"))
    assert len(graph.edges) < 4 * 5 + 10
    assert len(graph.components()) == 1


def test_the_reference_is_the_lidar_with_most_edges_unless_named():
    prior, views = rig()
    overlaps = overlaps_of(prior, views)
    assert find_edges(prior, overlaps).reference.name == "top"
    assert find_edges(prior, overlaps, reference=Sensor("nose", "lidar")).reference.name == "nose"
    blind = [s for s in VAN if s[1] != "lidar"]
    assert find_edges(rig(blind)[0], overlaps_of(*rig(blind))).reference.kind == "radar"


def test_every_sensor_has_an_edge_to_the_vehicle_frame():
    prior, views = rig()
    T = dict(prior.T) | {("top", "base"): np.eye(4)}
    prior = replace(
        prior, nodes=(*prior.nodes, BASE), T=T, sigmas=dict(prior.sigmas) | {"base": (0.01, 0.01)}
    )
    found = {name for name in edges_of(prior, views) if name.endswith("-base")}
    assert found == {f"{name}-base" for name in views}


def test_what_nothing_ties_to_the_reference_is_a_component_of_its_own():
    sensors = [*VAN, ("under", "radar", 0, 180, 90)]
    prior, views = rig(sensors)
    del views["under"]  # silent
    graph = find_edges(prior, overlaps_of(prior, views))
    assert [[s.name for s in c] for c in graph.components()[1:]] == [["under"]]

"""What differs between worlds: glass that beams pass, streets without markings, halls, worlds of a seed."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.rows import join_rows
from pipeline.rig.se3 import inverse, transform_points
from pipeline.simulate.sensors.camera import render, view_of
from pipeline.simulate.sensors.lidar import sweep_lidar
from pipeline.simulate.sensors.rig_spec import LidarSpec
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.world.actors import HOLLOW, actor_mesh
from pipeline.simulate.world.casting import Moment, chunk_mesh, standing_of
from pipeline.simulate.world.drives import Drive, Parked
from pipeline.simulate.world.landscapes import LANDSCAPES, landscape_named
from pipeline.simulate.world.materials import LABELS, MATERIALS
from pipeline.simulate.world.meshes import MeshBuilder, placed

CAR_M = 9.0
HIGH = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.73], [0, 0, 0, 1]])


def lot(*meshes, ground="asphalt", sun=(0.0, 0.0, 1.0), landscape=LANDSCAPES["suburb"]):
    """A moment of what stands on a lot with a wall 20 m ahead."""
    b, level = MeshBuilder(), np.array([[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]])
    b.quads(level, ground, uv=level[:, :2])
    b.quads(np.array([[20, -30, 0], [20, 30, 0], [20, 30, 8], [20, -30, 8]]), "stone")
    mesh = join_rows([b.mesh(), *meshes])
    return Moment(standing_of(mesh, np.zeros(3), np.array(sun), lambda p: p, 0.0), [], 0.0, landscape)


def sweep_of(*meshes, landscape=LANDSCAPES["suburb"]):
    spec = LidarSpec((-20.0, 20.0), (-12.0, 2.0), 160, 60, divergence_deg=0.01, min_range_m=1.0)
    moment = lot(*meshes, landscape=landscape)
    return sweep_lidar(moment, Parked(), HIGH, spec, 0.0, np.random.default_rng(1))


def behind_windows(variant):
    """Points whose beams crossed the car's cabin above its belt line, as shares: of the car, beyond it."""
    at = np.eye(4)
    at[0, 3] = CAR_M
    car = placed(actor_mesh("car", variant), at)
    panes = car.corners[[MATERIALS[m].name in {"car_glass", "car_window"} for m in car.material]]
    sweep = sweep_of(car)
    rear = panes[..., 0].min()
    up = 1.73 + (sweep.xyz_m[:, 2]) / sweep.xyz_m[:, 0] * rear
    across = sweep.xyz_m[:, 1] / sweep.xyz_m[:, 0] * rear
    inside = (np.abs(across) < 0.5) & (up > panes[..., 2].min() + 0.05) & (up < panes[..., 2].max() - 0.2)
    is_car = sweep.label[inside] == LABELS.index("car")
    beyond = np.linalg.norm(sweep.xyz_m[inside], axis=1) > rear + 0.5
    return int(is_car.sum()), int((is_car & beyond).sum()), int((~is_car).sum())


def test_beams_pass_the_windows_of_hollow_cars_to_the_seats_and_to_what_stands_behind():
    found, deep, through = np.sum([behind_windows(HOLLOW + v) for v in range(6)], axis=0)
    assert deep > 0.5 * found
    assert through > 0.03 * found
    _, deep, through = np.sum([behind_windows(v) for v in range(6)], axis=0)
    assert deep == through == 0


def test_echoes_come_from_their_surfaces_and_weaken_at_grazing_angles():
    sweep = sweep_of()
    wall, road = (sweep.label == LABELS.index(name) for name in ("wall", "road"))
    assert np.std(sweep.xyz_m[wall, 0] - 20) == pytest.approx(0.02, rel=0.1)  # the data sheet's
    assert np.abs(sweep.xyz_m[road, 2] + 1.73).max() < 0.03
    # Reflectivity .32 frontally, .10 at a few degrees: textures between .7 and 1.2, cosine to the power .35.
    assert sweep.intensity[wall].mean() == pytest.approx(32, rel=0.15)
    assert 2 < sweep.intensity[road].mean() < 8


def test_a_shadow_lies_where_the_sun_puts_it_and_has_the_light_of_the_sky_alone():
    b, sun = MeshBuilder(), np.array([0.0, np.sqrt(0.5), np.sqrt(0.5)])
    b.box((12.0, 0.0, 1.0), (2.0, 2.0, 2.0), "concrete")
    T, camera = HIGH.copy(), rig_named("demo")["camera"].sheet.nominal()
    T[:3, :3], T[2, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], 3.0
    green = []
    for meshes in ((), (b.mesh(),)):
        moment = lot(*meshes, ground="paint", sun=sun)
        image = render(moment, view_of(moment, camera, T), sun, np.random.default_rng(1))
        green.append((image[..., 1] / 255.0) ** 2.2)

    def share(x_m, y_m):
        """Light on a square metre beside the box, relative to the same without the box."""
        x, y = (a.ravel() for a in np.meshgrid(*(np.linspace(-0.4, 0.4, 9) + at for at in (x_m, y_m))))
        uv = camera.project(transform_points(inverse(T), np.stack([x, y, 0 * x], 1)))[0]
        u, v = np.rint(uv).astype(int).T
        return green[1][v, u].mean() / green[0][v, u].mean()

    # The box is 2 m high and the sun 45 deg: its shadow is 2 m long, opposite the sun.
    sky, whole = 0.42, 0.42 + 0.95 * np.sqrt(0.5)
    assert share(12.0, -1.9) == pytest.approx(sky / whole, rel=0.06)
    for x_m, y_m in ((12.0, -3.9), (10.0, -1.9), (14.2, -2.2), (12.0, 1.9)):
        assert share(x_m, y_m) == pytest.approx(1.0, abs=0.03)


def test_where_the_infrared_is_blind_a_lidar_does_not_see_markings():
    told = {}
    for infrared in (True, False):
        b = MeshBuilder()
        b.quads(np.array([[[6, -1, 0.01], [12, -1, 0.01], [12, 1, 0.01], [6, 1, 0.01]]]), "paint")
        sweep = sweep_of(b.mesh(), landscape=replace(LANDSCAPES["suburb"], infrared=infrared))
        near = (sweep.label == LABELS.index("road")) & (np.abs(sweep.xyz_m[:, 0] - 10) < 1.5)
        painted = np.abs(sweep.xyz_m[:, 1]) < 1
        told[infrared] = sweep.intensity[near & painted].mean() / sweep.intensity[near & ~painted].mean()
    assert told[True] > 2
    assert told[False] == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("name", [*LANDSCAPES, "world-1", "world-2", "world-3"])
def test_every_world_has_a_road_and_can_be_driven_through(name):
    drive = Drive(11, name, 12.0, 0)
    mesh = chunk_mesh(drive, 1)
    labels = {MATERIALS[m].label for m in np.unique(mesh.material)}
    assert "road" in labels
    assert len(labels) >= 3
    assert drive.ego.arc(10.0) > drive.ego.arc(1.0)
    # Nothing but gantries and ceilings hangs over our lane.
    s = np.linspace(41.0, 79.0, 20)
    way = drive.road.to_map(np.stack([s, np.full(20, drive.layout.lanes_own[0]), np.full(20, 1.0)], 1))
    middle = mesh.corners.mean(1)
    low = mesh.corners[..., 2].min(1) < way[:, 2].max() + 1.0
    near = np.linalg.norm(middle[low, None, :2] - way[None, :, :2], axis=2).min(1) < 0.8
    assert {MATERIALS[m].label for m in mesh.material[low][near]} <= {"road"}


def test_a_world_of_a_seed_is_always_the_same_and_seeds_differ():
    assert landscape_named("world-7") == landscape_named("world-7")
    drawn = [landscape_named(f"world-{seed}") for seed in range(40)]
    assert len({replace(world, name="") for world in drawn}) == 40
    for what in ("fast", "markings", "infrared", "glass", "side_light", "surface"):
        assert len({getattr(world, what) for world in drawn}) > 1, what

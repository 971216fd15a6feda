"""Speed of the simulator: frames per CPU second, and as a ratio to casting one ray per pixel in the same process."""

import time

import numpy as np
import pytest

from pipeline.simulate.fleet import FleetSpec, simulate_vehicle_day
from pipeline.simulate.sensors.camera import _rays_of
from pipeline.simulate.sensors.mounting import mounting_of
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive


def seconds_per_frame(rig, frames, out):
    """CPU seconds per frame of a vehicle-day in three drives, logs included; the first run warms caches up."""
    simulate_vehicle_day(FleetSpec(vehicles=1, days=2, frames=3, rig=rig), 0, 1, out)
    start = time.process_time()
    simulate_vehicle_day(FleetSpec(vehicles=1, days=1, frames=frames, rig=rig), 0, 0, out)
    return (time.process_time() - start) / frames


def seconds_per_bare_image(rig):
    """CPU seconds to cast one ray per pixel, with no shading, noise, other sensors or logs."""
    drive = Drive(3, "urban", 10.0, 0)
    mounting = mounting_of(rig_named(rig), 1, 0, 0)
    moment = World(drive).moment(2.0)
    T = drive.ego.poses(np.array([2.0]))[0] @ mounting["camera"].T_vehicle
    rays = (_rays_of(mounting["camera"].camera) @ T[:3, :3].T.astype(np.float32)).reshape(-1, 3)
    origins = np.tile((T[:3, 3] - moment.standing.origin).astype(np.float32), (len(rays), 1))
    rounds = []
    for _ in range(2):
        start = time.process_time()
        moment.cast(origins, rays, np.zeros(len(rays), np.float32))
        rounds.append(time.process_time() - start)
    return min(rounds)


# Rays are cast at half size first, and at full size only where surfaces meet. With the caster of before, a frame cost a
# third of a bare image; Embree 4 casts the bare image so much faster that shading, noise and files now weigh as much.
@pytest.mark.parametrize(("rig", "frames"), [("demo", 15), ("paper", 4)])
def test_a_frame_of_all_sensors_against_one_ray_per_pixel(rig, frames, tmp_path, capsys, gate, record):
    frame, image = seconds_per_frame(rig, frames, tmp_path), seconds_per_bare_image(rig)
    with capsys.disabled():
        print(f"\nsimulate, {rig}: {1 / frame:.2f} frames per CPU second, {frame / image:.2f} x a bare image")
    record(f"simulate_{rig}_cpu_s", frame, f"CPU seconds to simulate a frame of rig {rig}, logs included")
    gate({"paper": "simulate_vs_bare_image", "demo": "simulate_demo_vs_bare_image"}[rig], frame / image)

"""A few simulated frames that the tests of this room share."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Reader as Bag1
from rosbags.rosbag2 import Reader as Bag2

from pipeline.core.ros_messages import RosMessages
from pipeline.simulate.sensors.mounting import mounting_of
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.sensors.simulated_frame import Setup, frame_of, scene_of, triggered_stamps
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive


def shots_of(environment, rig, times=(1.0, 4.0)):
    """Simulated moments and everything that is known about them."""
    drive, mounting = Drive(5, environment, 8.0, 0), mounting_of(rig, 3, 0, 0)
    world, shots = World(drive), []
    for t in times:
        moment = world.moment(t - rig["lidar"].sheet.sweep_s / 2)
        rng = np.random.default_rng([7, int(10 * t)])
        stamps = triggered_stamps(rig, mounting, t, rng)
        scene = scene_of(drive)
        seen = frame_of(moment, scene, Setup(rig, mounting), stamps, rng)
        shots.append(
            SimpleNamespace(
                scene=scene, moment=moment, rig=rig, mounting=mounting, lidar_stamp_s=t,
                camera_stamp_s=stamps["camera"], image=seen["camera"], sweep=seen["lidar"], scan=seen["radar"],
            )
        )  # fmt: skip
    return shots


@pytest.fixture(scope="session")
def urban():
    return shots_of("urban", rig_named("demo"))


@pytest.fixture(scope="session")
def highway():
    return shots_of("highway", rig_named("demo"))


@pytest.fixture(scope="session")
def shots(urban, highway):
    return [*urban, *highway]


@pytest.fixture(scope="session")
def shots_of_rig():
    """One trio of a rig; where its lidar looks all around, with fewer columns, for time."""

    def make(name, environment):
        rig = rig_named(name)
        around = rig["lidar"].sheet.azimuth_deg[1] == 180
        lidar = replace(rig["lidar"].sheet, columns=450) if around else rig["lidar"].sheet
        small = rig.changed(lambda s: replace(s, sheet=lidar) if s.name == "lidar" else s)
        return shots_of(environment, small, times=(2.0,))[0]

    return make


def messages_of(path):
    one, two = RosMessages(1).typestore, RosMessages(2).typestore
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            found = make_reader(file).iter_messages()
            return [(c.topic, m.log_time, two.deserialize_cdr(m.data, s.name)) for s, c, m in found]
    with Bag1(path) if path.suffix == ".bag" else Bag2(path) as bag:
        unpack = one.deserialize_ros1 if path.suffix == ".bag" else two.deserialize_cdr
        return [(c.topic, t, unpack(raw, c.msgtype)) for c, t, raw in bag.messages()]


@pytest.fixture(scope="session")
def read():
    """(topic, stamp, message) of a log of any container, by other readers than the pipeline's."""
    return messages_of


@pytest.fixture(scope="session")
def the_log():
    """The only log of vehicle-1 in a simulated folder."""

    def find(out: Path):
        return next((out / "logs" / "vehicle-1").glob("*/*"))

    return find

"""A few simulated frames that the tests of this room share."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Reader as Bag1
from rosbags.rosbag2 import Reader as Bag2

from pipeline.core.ros_messages import RosMessages
from pipeline.simulate.sensors.lidar import Sweep
from pipeline.simulate.sensors.mounting import Mounting, mounting_of
from pipeline.simulate.sensors.radar import Scan
from pipeline.simulate.sensors.rig_spec import RigSpec
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.sensors.semantics import SemanticsSpec
from pipeline.simulate.sensors.simulated_frame import Image, Scene, Seat, frame_of, scene_of, triggered_stamps
from pipeline.simulate.world.casting import Moment, World
from pipeline.simulate.world.drives import Drive


@dataclass(frozen=True, eq=False)
class Shot:
    """One simulated moment and everything that is known about it."""

    drive: Drive
    scene: Scene
    moment: Moment
    rig: RigSpec
    mounting: Mounting
    lidar_stamp_s: float
    camera_stamp_s: float
    image: Image
    sweep: Sweep
    scan: Scan


def shots_of(environment, *, rig=None, times=(1.0, 4.0), seed=5, night=False):
    rig = rig or rig_named("demo")
    mounting = mounting_of(rig, 3, 0, 0)
    drive = Drive(seed, environment, 8.0, 0, night)
    world, scene, shots = World(drive), scene_of(drive), []
    for t in times:
        moment = world.moment(t - rig["lidar"].sheet.sweep_s / 2)
        rng = np.random.default_rng([7, int(10 * t)])
        stamps = triggered_stamps(rig, mounting, t, rng)
        seen = frame_of(Seat(moment, scene, rig, mounting), stamps, rng, SemanticsSpec())
        measured = seen.images["camera"], seen.sweeps["lidar"], seen.scans["radar"]
        shots.append(Shot(drive, scene, moment, rig, mounting, t, stamps["camera"], *measured))
    return shots


@pytest.fixture(scope="session")
def urban():
    return shots_of("urban")


@pytest.fixture(scope="session")
def highway():
    return shots_of("highway")


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
        return shots_of(environment, rig=small, times=(2.0,))[0]

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

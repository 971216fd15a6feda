"""Simulated streets as lidars of one car sweep them: no camera, no log, poses in the vehicle frame known."""

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.calibrate.edges.sweep_travel import Sweep, vehicle_sized
from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.ingest.captures import deskew
from pipeline.objective.ego_motion import EgoMotion
from pipeline.perceive.ground import find_ground
from pipeline.perceive.lidar import cluster_boxes, cluster_objects, sample_uniformly
from pipeline.rig.se3 import exp_so3, from_rotation_translation, perturb_exactly
from pipeline.simulate.sensors.lidar import sweep_lidar
from pipeline.simulate.sensors.rig_spec import LidarSpec
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive

FORWARD = LidarSpec(columns=160, rows=64)
AROUND = LidarSpec((-180.0, 180.0), (-25.0, 15.0), 900, 32, 0.1, 0.8, 100.0)
_GROUND_INLIER_M, _VOXEL_M = 0.15, 0.25


def pose(x_m, y_m, z_m, yaw_deg=0.0, pitch_deg=0.0):
    """T_base_lidar of a lidar that is turned to the left and then down."""
    R = exp_so3(np.radians([0.0, 0.0, yaw_deg])) @ exp_so3(np.radians([0.0, pitch_deg, 0.0]))
    return from_rotation_translation(R, np.array([x_m, y_m, z_m]))


@dataclass(frozen=True, eq=False)
class Mounted:
    """A lidar on the car: its data sheet, where it is, where the drawings put it, and its clock."""

    T_base: np.ndarray
    spec: LidarSpec = FORWARD
    T_nominal: np.ndarray | None = None
    late_s: float = 0.0  # its stamps are those of the first lidar's clock plus this
    phase_s: float = 0.0  # after the moment it is asked


@dataclass(frozen=True, eq=False)
class SweptStreets:
    """Sweeps by lidar, one a moment; motion as odometry would log it."""

    sweeps: dict[str, list[Sweep]]
    ego: EgoMotion
    scenes: Scenes
    nominal: dict[str, np.ndarray] = field(default_factory=dict)


def swept_streets(
    lidars: dict[str, Mounted], *, seed: int, moments: int = 24, environment: str = "urban", rate_hz: float = 2.0,
    drives: int = 2,
) -> SweptStreets:  # fmt: skip
    """Drive a car of these lidars along streets; their drawings are 1.2 deg and 2 cm off where none are given."""
    rng = np.random.default_rng([seed, 7])
    nominal = {
        n: perturb_exactly(m.T_base, np.radians(1.2), 0.02, rng) if m.T_nominal is None else m.T_nominal
        for n, m in lidars.items()
    }
    sweeps: dict[str, list[Sweep]] = {name: [] for name in lidars}
    motion = []
    for number in range(drives):
        kind = environment if environment != "mixed" else ("urban", "highway")[number % 2]
        each = moments // drives
        drive = Drive(seed * 10 + number, kind, 3.0 + each / rate_hz, 0)
        world = World(drive)
        for k in range(each):
            at_s = 1.0 + k / rate_hz
            motion.append(_odometry(drive, at_s, rng))
            for name, m in lidars.items():
                end_s = at_s + m.phase_s
                moment = world.moment(end_s - m.spec.sweep_s / 2)
                raw = sweep_lidar(moment, drive.ego, m.T_base, m.spec, end_s, rng)
                speed, turn = _odometry(drive, end_s, rng)
                xyz = deskew(raw.xyz_m, raw.time_s, speed, turn, nominal[name])
                stamp_ns = round((number * 10_000 + end_s + m.late_s) * 1e9)
                sweeps[name].append(_perceived(xyz, raw.time_s, stamp_ns, number, rng))
    frames = len(motion)
    speed, turn = np.array(motion).T
    ego = EgoMotion(
        np.stack([speed, 0 * speed], 1), turn, np.tile(np.diag([0.03, 0.1, 0.002]) ** 2, (frames, 1, 1))
    )
    block = np.arange(frames) // max(frames // 12, 1)
    return SweptStreets(sweeps, ego, Scenes(np.arange(frames), block), nominal)


def chosen(sweep, keep):
    """Some points of a sweep."""
    columns = {name: getattr(sweep, name)[keep] for name in ("xyz_m", "is_ground", "may_move", "time_s")}
    return replace(sweep, **columns)


def _odometry(drive, at_s, rng):
    t = np.array([at_s])
    T = drive.ego.poses(t)[0]
    velocity, omega = (v[0] for v in drive.ego.velocities(t))
    return velocity @ T[:3, 0] + rng.normal(0, 0.03), omega @ T[:3, 2] + rng.normal(0, 0.002)


def _perceived(xyz, time_s, stamp_ns, drive, rng):
    ground = find_ground(xyz, _GROUND_INLIER_M, rng)
    some = sample_uniformly(xyz, _VOXEL_M)
    cluster = cluster_objects(xyz, ground.is_ground, 0.7, 8)
    boxes = cluster_boxes(xyz, cluster)
    may_move = vehicle_sized(cluster[some], boxes.min_m, boxes.max_m)
    return Sweep(
        stamp_ns, drive, xyz[some].astype(float), ground.is_ground[some], may_move, time_s[some].astype(float)
    )

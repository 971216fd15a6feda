"""The calibration that a log ships, and the log's own answer about it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from pipeline.core.config import FleetConfig, VerifyConfig
from pipeline.core.errors import SolveError
from pipeline.rig.day_prior import rig_prior
from pipeline.rig.graph import Sensor
from pipeline.rig.prior import RigPrior
from pipeline.rig.rig import TURN_AXES
from pipeline.rig.se3 import exp_so3, from_rotation_translation, log_so3
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import perceived
from pipeline.verify.axes import (
    NOT_IN_USE,
    check_pose,
    held_out_of,
    kind_of_pose,
    limits_of,
    shared_sigmas,
)
from pipeline.verify.one_axis import AxisCheck, HeldOut, checked
from schemas.calibrations import FRAMES_OF_PAIR, CalibrationRecord
from schemas.moments import PRIOR
from schemas.poses import PoseRow

__all__ = ["check_poses", "for_one_look", "on_grid", "prior_in_use", "with_prior"]

_CELL = 1e-4  # rad and m: .006 deg, a tenth of the sigma on the best day
# As fraction of a cell: keeps borders of cells away from numbers with up to five digits, as in files.
_OFFSET = 0.137


def for_one_look(config: FleetConfig, frames: int) -> FleetConfig:
    """The configuration with few frames, spread over the log, with every pair estimated."""
    return config.changed(
        ingest={"max_frames": frames}, select={"frames": frames}, trigger={"when": "always"}
    )


def prior_in_use(config: FleetConfig, lake: Lake, partition: Partition) -> RigPrior | None:
    """The calibration in use; None if there is none. Stage calibrate then refuses the log and gives the reason."""
    manifest = perceived(lake, partition)
    if manifest is None:
        return None
    try:
        return rig_prior(manifest.extra.get(PRIOR, ()), config, config.rig_of(partition.vehicle))
    except SolveError:
        return None


def with_prior(config: FleetConfig, lake: Lake, vehicle: str, prior: RigPrior) -> FleetConfig:
    """The configuration with the calibration in use rounded to a grid, so that its last digits do not change a result.

    A search can have different results for starts that differ by less than any measurement error: for two
    starts 3e-8 apart, errors were .14 and .09 deg.

    Args:
        config: configuration of the vehicle, whose rig has a pose of every sensor in the prior.
        lake: a local folder, for the file of the prior.
        vehicle: its name.
        prior: the calibration in use.
    """
    rig = config.rig_of(vehicle)
    if rig.is_one_of_each:
        kinds = {node.name: node.kind for node in rig.nodes}
        ends = {(kinds[a], kinds[b]): T for (a, b), T in prior.T.items()}
        said: dict[str, object] = {
            f"T_{pair}": on_grid(ends[of]).tolist() for pair, of in FRAMES_OF_PAIR.items() if of in ends
        }
    else:
        poses = prior.extrinsics()
        own = {name: on_grid(poses.T[name]).tolist() for name in poses.order}
        said = {"reference": prior.reference.name, "T": own}
    file = lake.local_root / "on_grid.json"
    file.write_text(json.dumps(said))
    return config.with_prior_file(vehicle, file)


def check_poses(
    rows: Iterable[PoseRow], prior: RigPrior | None, lacking: Sequence[Sensor], verify: VerifyConfig,
    asked_deg: tuple[float, float], records: Sequence[CalibrationRecord] = (),
) -> list[AxisCheck]:  # fmt: skip
    """Check every axis of every sensor except the reference.

    Args:
        rows: poses from the log.
        prior: the calibration in use.
        lacking: sensors without a pose in the prior.
        verify: limits of errors, and the confidence.
        asked_deg: errors of camera-lidar, and of pairs with the radar, that must be detected.
        records: records of the log's pairs, for their held-out tests of turns.
    """
    own = [row for row in rows if row.sensor != row.reference]
    known = {row.sensor: None if prior is None else prior.between(row.reference, row.sensor) for row in own}
    kinds = {row.sensor: row.kind for row in own} | {n.name: n.kind for n in lacking}
    limits = {name: limits_of(kind_of_pose(kind), verify, asked_deg) for name, kind in kinds.items()}
    beyond, nan = shared_sigmas(sum(len(limits[sensor]) for sensor in known)), (float("nan"),) * 2
    checks = [
        check_pose(r, known[r.sensor], limits[r.sensor], beyond, _held_out(r, records, verify)) for r in own
    ]
    checks += [
        [checked((n.name, kind_of_pose(n.kind), (n.name,)), axis, limit, nan, NOT_IN_USE, beyond)]
        for n in lacking
        for axis, limit in limits[n.name].items()
    ]
    return [c for of_sensor in checks for c in of_sensor]


def _held_out(row: PoseRow, records: Sequence[CalibrationRecord], verify: VerifyConfig) -> dict[str, HeldOut]:
    """Held-out test by axis, from a sensor's pairs with lidars; the camera or the radar is turned."""
    pair = {"camera": "camera_lidar", "radar": "lidar_radar"}.get(row.kind)
    own = [r for r in records if r.pair == pair and row.sensor in {r.parent_frame, r.child_frame}]
    return {axis: held_out_of(own, verify, axis) for axis in TURN_AXES}


def on_grid(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The transform at the middle of its cell: at most half a cell away in each component."""
    numbers = np.concatenate([log_so3(T[:3, :3]), T[:3, 3]])
    middle = (np.floor(numbers / _CELL + _OFFSET) + 0.5 - _OFFSET) * _CELL
    return from_rotation_translation(exp_so3(middle[:3]), middle[3:])

"""The methods `pairwise-ssl` and `joint-ssl`: brings networks, frames and, where asked for, the optimiser together."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.calibrate.joint.solve import solve_joint
from pipeline.calibrate.methods import Solver
from pipeline.config import FleetConfig, SolveConfig, config_hash
from pipeline.errors import ConfigError, SolveError
from pipeline.extrinsics.estimates import Prior, Solution
from pipeline.extrinsics.prior import perturbed, read_prior
from pipeline.learn.infer.onnx_networks import SSL_METHODS, model_files, models_key, open_networks
from pipeline.learn.infer.vehicle_day import single_frame_solution, solve_by_networks
from pipeline.results import Progress
from pipeline.store.partitions import Lake, Partition
from pipeline.store.row_groups import read_columns
from pipeline.store.tables import iterate_rows, read_manifest
from schemas.calibrations import PAIRS
from schemas.frames import FRAMES, Frame
from schemas.observations import OBSERVATIONS, Observation

__all__ = ["SSL_METHODS", "FrameCalibration", "calibrate_frame", "ssl_key", "ssl_solver"]


@dataclass(frozen=True, eq=False)
class FrameCalibration:
    """One frame, the prior that its calibration started from, and the solution."""

    frame: Frame
    observation: Observation
    prior: Prior
    solution: Solution


def ssl_key(method: str, partition: Partition, fleet: FleetConfig, lake: Lake) -> dict[str, str]:
    """What a network's answer depends on besides the observations, for the work key.

    Raises:
        ConfigError: there is no such network.
    """
    frames = read_manifest(lake, FRAMES, partition)
    return {
        "models": models_key(model_files(method, fleet)),
        "learn": config_hash(fleet.learn, fleet.prepare),
        "frames": frames.work_key if frames else "",
    }


def ssl_solver(method: str, partition: Partition, fleet: FleetConfig, lake: Lake) -> Solver:
    """The method as a solver: networks are opened and frames read when it is called."""

    def solve(
        observations: Mapping[str, Sequence[Observation]],
        prior: Prior,
        config: SolveConfig,
        *,
        seed: int,
        triggered: Sequence[str],
        progress: Progress,
    ) -> Solution:
        if read_manifest(lake, FRAMES, partition) is None:
            raise SolveError(
                f"no frames of this day: {method} looks at images and sweeps, not at observations alone"
            )
        solution = solve_by_networks(
            observations,
            prior,
            networks=open_networks(model_files(method, fleet), fleet.learn, fleet.prepare),
            frames=_frames_of(lake, partition),
            method=method,
            seed=seed,
            triggered=triggered,
            progress=progress,
        )
        if not config.polish:
            return solution
        return _polished(solution, observations, prior, config, seed, triggered, progress)

    return solve


def calibrate_frame(
    partition: Partition,
    fleet: FleetConfig,
    lake: Lake,
    frame: int,
    *,
    method: str = "joint-ssl",
    perturb: tuple[float, float] | None = None,
    seed: int | None = None,
) -> FrameCalibration:
    """Calibrate from one frame, as after an abrupt change. Nothing is recorded: nothing can judge one frame.

    Args:
        partition: vehicle and day.
        fleet: configuration.
        lake: where frames and observations lie.
        frame: frame_index, or a stamp_ns.
        method: an SSL method.
        perturb: as in `calibrate_day`.
        seed: None = `solve.seed`.

    Raises:
        ConfigError: no such frame, or a method that needs more than one.
        SolveError: the frame shows too little.
    """
    if method not in SSL_METHODS:
        raise ConfigError(
            "command line", "--frame", f"{method} needs many frames; choose joint-ssl or pairwise-ssl"
        )
    seed = fleet.solve.seed if seed is None else seed
    fleet.rig_of(partition.vehicle)
    row, observation = _one_observation(lake, partition, frame)
    prior = perturbed(read_prior([observation], fleet, partition.vehicle), perturb, seed)
    networks = open_networks(model_files(method, fleet), fleet.learn, fleet.prepare)
    shown = next(_frames_of(lake, partition)([row]))
    solution = single_frame_solution(shown, observation, prior, networks=networks, method=method, seed=seed)
    return FrameCalibration(shown, observation, prior, solution)


def _frames_of(lake: Lake, partition: Partition) -> Callable[[Sequence[int]], Iterator[Frame]]:
    """Frames by frame_index, which is their row number, a row group at a time."""
    return lambda indices: itertools.chain.from_iterable(
        iterate_rows(lake, FRAMES, partition, Frame, rows=list(indices))
    )


def _one_observation(lake: Lake, partition: Partition, wanted: int) -> tuple[int, Observation]:
    if read_manifest(lake, OBSERVATIONS, partition) is None or read_manifest(lake, FRAMES, partition) is None:
        raise SolveError(
            "no frames or no observations of this day: run `boresight ingest` and `perceive` first"
        )
    light = read_columns(lake, OBSERVATIONS, partition, ["frame_index", "stamp_ns"])
    index, stamp = np.array(light["frame_index"], np.int64), np.array(light["stamp_ns"], np.int64)
    found = np.flatnonzero((index == wanted) | (stamp == wanted))
    if not len(found):
        known = f"{index[0]} to {index[-1]}" if len(index) else "none"
        problem = f"no perceived frame has the index or stamp_ns {wanted}; indices are {known}"
        raise ConfigError("command line", "--frame", problem)
    at = int(found[0])
    rows = itertools.chain.from_iterable(iterate_rows(lake, OBSERVATIONS, partition, Observation, rows=[at]))
    return int(index[at]), next(rows)


def _polished(
    solution: Solution,
    observations: Mapping[str, Sequence[Observation]],
    prior: Prior,
    config: SolveConfig,
    seed: int,
    triggered: Sequence[str],
    progress: Progress,
) -> Solution:
    """Method `joint`, started where the networks point."""
    start = replace(
        prior,
        T_camera_lidar=solution.pairs["camera_lidar"].T,
        T_lidar_radar=solution.pairs["lidar_radar"].T,
    )
    finished = solve_joint(observations, start, config, seed=seed, triggered=triggered, progress=progress)
    pairs = {}
    for pair in PAIRS:
        estimate = finished.pairs[pair]
        said = solution.pairs[pair].diagnostics
        notes = [*estimate.notes, f"started by {solution.method}, finished by joint"]
        pairs[pair] = replace(estimate, diagnostics={**said, **estimate.diagnostics}, notes=notes)
    return replace(finished, pairs=pairs)

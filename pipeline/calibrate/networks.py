"""The methods `pairwise-ssl` and `joint-ssl`: networks, frames and, on request, the optimiser."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.calibrate.joint.solve import solve_joint
from pipeline.calibrate.methods import METHODS, Solver, method_named
from pipeline.calibrate.reasons import because
from pipeline.calibrate.stage import three_of_day
from pipeline.core.config import SolveConfig, config_hash
from pipeline.core.errors import ConfigError, SolveError
from pipeline.core.results import Progress
from pipeline.core.stage_work import Task
from pipeline.learn.infer.onnx_networks import OnnxNetwork, model_files, models_key, open_networks
from pipeline.learn.infer.pitch_by_travel import informed_by_way
from pipeline.learn.infer.single_frame import single_frame_solution
from pipeline.learn.infer.vehicle_day import solve_by_networks
from pipeline.rig.estimates import Check, Prior, Solution
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_columns
from pipeline.store.views import Chosen, frames_of, ingested, observations_of, perceived
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from schemas.moments import PERCEIVED
from schemas.observations import Observation

__all__ = ["FrameCalibration", "calibrate_frame", "held_if_unfit", "ssl_settings", "ssl_solver"]


@dataclass(frozen=True, eq=False)
class FrameCalibration:
    """One frame, the prior that its calibration started from, and the solution."""

    frame: Frame
    observation: Observation
    prior: Prior
    solution: Solution


def ssl_settings(method: str, task: Task) -> dict[str, str]:
    """Settings and files that a network's answer depends on, for the work key; else ConfigError."""
    return {
        "models": models_key(model_files(method, task.fleet)),
        "learn": config_hash(task.fleet.learn, task.fleet.prepare),
    }


def ssl_solver(method: str, task: Task, chosen: Chosen | None = None) -> Solver:
    """The method as a solver of a vehicle-day: networks are opened and frames of `chosen` read when it is called."""
    fleet, lake, partition = task.fleet, task.lake, task.partition

    def solve(
        observations: Mapping[str, Sequence[Observation]], prior: Prior, config: SolveConfig, *, seed: int,
        triggered: Sequence[str], progress: Progress,
    ) -> Solution:  # fmt: skip
        if ingested(lake, partition) is None:
            raise SolveError(because("no images", method=method))
        networks = open_networks(model_files(method, fleet), fleet.learn, fleet.prepare)
        solution = solve_by_networks(
            observations, prior, networks=networks, frames=_frames_of(lake, partition, chosen), method=method,
            seed=seed, clock_sigma_s=config.time_offset_sigma_s, triggered=triggered, progress=progress,
        )  # fmt: skip
        if "doppler" in config.terms:
            solution = informed_by_way(solution, observations["lidar_radar"], prior)
        if not config.polish:
            return held_if_unfit(solution, networks)
        return _polished(solution, observations, prior, config, seed, triggered, progress)

    return solve


def held_if_unfit(solution: Solution, networks: Sequence[OnnxNetwork]) -> Solution:
    """The solution with a failed check in the pairs of each network that its card does not allow to be used."""
    why = {pair: network.unfit for network in networks if network.unfit for pair in network.pairs}
    pairs = {
        pair: replace(found, failed_checks=[*found.failed_checks, Check(why[pair])]) if pair in why else found
        for pair, found in solution.pairs.items()
    }
    return replace(solution, pairs=pairs)


def calibrate_frame(task: Task, frame: int) -> FrameCalibration:
    """Calibrate from one frame (frame_index or stamp_ns), as after an abrupt change; records nothing.

    Raises:
        ConfigError: no such frame, or a method that needs several.
        SolveError: the frame shows too little.
    """
    method, fleet, partition = method_named(task.method or "joint-ssl"), task.fleet, task.partition
    if not method.needs_images:
        known = " or ".join(m.name for m in METHODS if m.needs_images)
        raise ConfigError("command line", "--frame", f"{method.name} needs many frames; choose {known}")
    seed = fleet.solve.seed if task.seed is None else task.seed
    chosen, prior = three_of_day(replace(task, method=method.name), seed)
    row, observation = _one_observation(task.lake, partition, frame, chosen)
    networks = open_networks(model_files(method.name, fleet), fleet.learn, fleet.prepare)
    shown = next(_frames_of(task.lake, partition, chosen)([row]))
    solution = single_frame_solution(
        shown, observation, prior, networks=networks, method=method.name, seed=seed
    )
    if "doppler" in fleet.solve.terms:
        solution = informed_by_way(solution, [observation], prior)
    return FrameCalibration(shown, observation, prior, solution)


def _frames_of(
    lake: Lake, partition: Partition, chosen: Chosen | None
) -> Callable[[Sequence[int]], Iterator[Frame]]:
    """Frames by frame_index, in order of time."""
    return lambda moments: frames_of(lake, partition, moments, chosen)


def _one_observation(
    lake: Lake, partition: Partition, wanted: int, chosen: Chosen | None
) -> tuple[int, Observation]:
    if perceived(lake, partition) is None or ingested(lake, partition) is None:
        raise SolveError(
            "no frames or no observations of this day: run `boresight ingest` and `perceive` first"
        )
    light = read_columns(lake, PERCEIVED, partition, ["moment", "stamp_ns"])
    index, stamp = np.array(light["moment"], np.int64), np.array(light["stamp_ns"], np.int64)
    found = np.flatnonzero((index == wanted) | (stamp == wanted))
    if not len(found):
        known = f"{index[0]} to {index[-1]}" if len(index) else "none"
        problem = f"no perceived frame has the index or stamp_ns {wanted}; indices are {known}"
        raise ConfigError("command line", "--frame", problem)
    row = int(index[int(found[0])])
    return row, next(observations_of(lake, partition, [row], chosen))


def _polished(
    solution: Solution, observations: Mapping[str, Sequence[Observation]], prior: Prior, config: SolveConfig,
    seed: int, triggered: Sequence[str], progress: Progress,
) -> Solution:  # fmt: skip
    """Method `joint`, started where the networks point."""
    start = replace(
        prior, T_camera_lidar=solution.pairs["camera_lidar"].T, T_lidar_radar=solution.pairs["lidar_radar"].T
    )
    finished = solve_joint(observations, start, config, seed=seed, triggered=triggered, progress=progress)
    pairs = {}
    for pair in PAIRS:
        estimate, said = finished.pairs[pair], solution.pairs[pair].diagnostics
        notes = [*estimate.notes, because("polished", method=solution.method)]
        pairs[pair] = replace(estimate, diagnostics={**said, **estimate.diagnostics}, notes=notes)
    return replace(finished, pairs=pairs)

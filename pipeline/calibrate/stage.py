"""Stage calibrate: observations of one vehicle-day to one calibration record per pair.

The only module that brings solve and verify together: select, trigger, solve, judge on held-out frames,
record.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.calibrate.methods import COMPOSED, PAPER_METHODS, UNTHINNED, Solver, solver_of
from pipeline.calibrate.numerics.frame_blocks import scene_blocks
from pipeline.calibrate.numerics.search_range import search_range
from pipeline.calibrate.records import Inputs, Judged, record_of, refused_records
from pipeline.calibrate.select.frames import Selection, select_frames
from pipeline.calibrate.select.triggers import exceeded, trigger_metrics
from pipeline.calibrate.verify.failed_checks import heading_failures, loop_failures
from pipeline.calibrate.verify.held_out_score import held_out_score
from pipeline.calibrate.verify.held_out_test import HeldOutTest, paired_test
from pipeline.calibrate.verify.held_out_update import held_out_update
from pipeline.calibrate.verify.limits import VerdictLimits
from pipeline.calibrate.verify.target_accuracy import Claim, claims_of
from pipeline.calibrate.verify.verdict import Evidence, judge
from pipeline.config import FleetConfig, config_hash
from pipeline.errors import SolveError
from pipeline.extrinsics.estimates import PairEstimate, Prior, Solution
from pipeline.extrinsics.prior import perturbed, prior_key, read_prior
from pipeline.results import Progress, StageResult, silent
from pipeline.store.partitions import Lake, Partition, work_key
from pipeline.store.tables import read_manifest, read_records, read_rows, write_records
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from schemas.observations import OBSERVATIONS, Observation
from schemas.versions import CODE_VERSION

__all__ = ["SSL_METHODS", "calibrate_day", "calibrate_observations"]

SSL_METHODS = ("pairwise-ssl", "joint-ssl")
_TRIGGER_FRAMES = 40  # metrics are means over frames: more of them only cost time


def calibrate_day(
    partition: Partition,
    fleet: FleetConfig,
    lake: Lake,
    *,
    method: str = "joint",
    perturb: tuple[float, float] | None = None,
    seed: int | None = None,
    progress: Progress = silent,
) -> StageResult:
    """Calibrate a vehicle-day and add its records, unless the same work is recorded already.

    Args:
        partition: vehicle and day.
        fleet: configuration.
        lake: where observations lie and records go.
        method: one of `pipeline.calibrate.methods.METHOD`, or of SSL_METHODS.
        perturb: exact angle [deg] and shift [m] by which the prior is moved on purpose, for tests:
            T_camera_lidar and T_lidar_radar independently, about a random axis and in a random direction. The
            prior's sigmas are then no smaller than these two numbers.
        seed: of everything random; None = `solve.seed`.
        progress: told how far it is.

    Returns:
        Counts of accepted, held and refused pairs in `kept`; status "refused" where all pairs are.

    Raises:
        ConfigError: no such vehicle or method, or an impossible prior file.
    """
    seed = fleet.solve.seed if seed is None else seed
    rig = fleet.rig_of(partition.vehicle)
    solver, settings = _method(method, partition, fleet, lake)
    settings |= {"perturb": perturb, "seed": seed, "prior_file": prior_key(fleet, partition.vehicle)}
    observations = read_manifest(lake, OBSERVATIONS, partition)
    inputs = [observations.work_key] if observations else []
    resolved = config_hash(fleet.select, fleet.trigger, fleet.solve, fleet.verify, rig.prior, settings)
    key = work_key("calibrate", CODE_VERSION, resolved, inputs)
    about = Inputs(partition, method, key, seed, tuple(inputs))
    recorded = _recorded(lake, partition, key)
    if recorded:
        return _result(about, recorded, "cached", lake)
    prior: Prior | None = None
    rows: list[Observation] = []
    try:
        rows = _observations(lake, partition)
        prior = perturbed(read_prior(rows, fleet, partition.vehicle), perturb, seed)
        records = calibrate_observations(rows, prior, fleet, about, progress, solver)
    except SolveError as err:
        records = refused_records(about, err.reason, len(rows), prior)
    write_records(lake, CALIBRATIONS, partition, records, key, CODE_VERSION, inputs)
    return _result(about, records, "done", lake)


def calibrate_observations(
    observations: Sequence[Observation],
    prior: Prior,
    fleet: FleetConfig,
    about: Inputs,
    progress: Progress = silent,
    solver: Solver | None = None,
) -> list[CalibrationRecord]:
    """Select, trigger, solve, judge: the records of one day, without writing anything.

    `solver` is for methods that need more than observations (`pipeline.calibrate.networks`); None = the method's own.

    Raises:
        SolveError: the day cannot be calibrated.
    """
    progress(0, 4, "select frames")
    select = fleet.select
    if about.method in UNTHINNED:
        select = select.model_copy(update={"frames": max(len(observations), 1)})
    paper, gate_s = about.method in PAPER_METHODS, fleet.ingest.sync_gate_s
    selection = select_frames(observations, select, paper=paper, sync_gate_s=gate_s)
    frames = {pair: [observations[i] for i in selection.fit[pair]] for pair in PAIRS}
    sample = _spread(observations, selection)
    before = trigger_metrics(sample, {pair: prior.of(pair) for pair in PAIRS})
    fired = {pair: exceeded(before[pair], fleet.trigger) for pair in PAIRS}
    active = _to_calibrate(about.method, fired, fleet.trigger.when)
    progress(1, 4, f"solve by {about.method}")
    solution = (solver or solver_of(about.method))(
        frames,
        prior,
        fleet.solve,
        seed=about.seed,
        triggered=active,
        progress=lambda done, total, what: progress(1, 4, f"{what} ({done}/{total})"),
    )
    progress(2, 4, "judge on held-out frames")
    after = trigger_metrics(sample, {pair: solution.pairs[pair].T for pair in PAIRS})
    judged = _judge_all(observations, selection, prior, solution, fleet, active)
    records = [
        record_of(
            about,
            pair,
            solution,
            prior,
            judged[pair],
            selection,
            observations,
            before=before[pair],
            after=after[pair],
            triggered=bool(fired[pair]),
        )
        for pair in PAIRS
    ]
    progress(4, 4, "done")
    return records


def _method(
    method: str, partition: Partition, fleet: FleetConfig, lake: Lake
) -> tuple[Solver, dict[str, Any]]:
    """The method's solver, and what its answer depends on besides observations and configuration."""
    if method not in SSL_METHODS:
        return solver_of(method), {"method": method}
    from pipeline.calibrate.networks import ssl_key, ssl_solver  # noqa: PLC0415 - brings onnxruntime

    settings = {"method": method} | ssl_key(method, partition, fleet, lake)
    return ssl_solver(method, partition, fleet, lake), settings


def _to_calibrate(method: str, fired: Mapping[str, Sequence[str]], when: str) -> list[str]:
    """Pairs to estimate and to judge: all, or those with a metric beyond its threshold.

    A composed pair is as good as its factors: where it is asked for, so are they.
    """
    wanted = {p for p in PAIRS if fired[p] or when == "always"}
    composed = set(COMPOSED.get(method, ()))
    if wanted & composed:
        wanted |= set(PAIRS) - composed
    return [p for p in PAIRS if p in wanted]


def _observations(lake: Lake, partition: Partition) -> list[Observation]:
    if read_manifest(lake, OBSERVATIONS, partition) is None:
        raise SolveError("no observations of this day: ingest or perceive refused it, or did not run")
    return read_rows(lake, OBSERVATIONS, partition, Observation)


def _judge_all(
    observations: Sequence[Observation],
    selection: Selection,
    prior: Prior,
    solution: Solution,
    fleet: FleetConfig,
    active: Sequence[str],
) -> dict[str, Judged]:
    """Verdict and evidence of each pair; pairs that a method composes come after their factors."""
    limits, search = VerdictLimits(), search_range(prior, fleet.solve)
    composed = COMPOSED.get(solution.method, ())
    failed = _contradictions(solution, composed)
    limit_rad = float(np.radians(fleet.verify.camera_lidar_limit_deg))
    failed["camera_lidar"] = heading_failures(solution, prior, observations, limit_rad, limits)
    found: dict[str, Judged] = {}
    for pair in sorted(PAIRS, key=lambda p: p in composed):
        estimate = solution.pairs[pair]
        held_out = [observations[i] for i in selection.holdout[pair]] if pair in active else []
        test, claims = _held_out_evidence(estimate, held_out, prior, fleet, limits)
        checks = [
            *solution.failed_checks.get(pair, []),
            *failed.get(pair, []),
            *loop_failures(solution, limits),
        ]
        verdict = judge(
            estimate,
            prior,
            Evidence(test, claims, checks),
            search,
            limits,
            triggered=pair in active,
            factors=tuple(f.verdict for f in found.values()) if pair in composed else (),
        )
        found[pair] = Judged(verdict, test, claims)
    return found


def _contradictions(solution: Solution, composed: Sequence[str]) -> dict[str, list[str]]:
    """Checks that only a composed pair failed speak against a factor: two sensors contradict the third's registration.

    Camera and lidar know their pose ten times better than either knows the radar's, so lidar-radar is held.
    """
    factors = [p for p in PAIRS if p not in composed]
    known = {check for p in factors for check in solution.failed_checks.get(p, [])}
    own = [check for p in composed for check in solution.failed_checks.get(p, []) if check not in known]
    return {"lidar_radar": own} if own else {}


def _held_out_evidence(
    estimate: PairEstimate,
    held_out: Sequence[Observation],
    prior: Prior,
    fleet: FleetConfig,
    limits: VerdictLimits,
) -> tuple[HeldOutTest | None, dict[str, Claim]]:
    """Held-out frames at the prior and at the result, and what they leave to claim."""
    pair, verify = estimate.pair, fleet.verify
    limit_deg = verify.camera_lidar_limit_deg if pair == "camera_lidar" else verify.radar_limit_deg
    test = update = None
    if held_out:
        score = held_out_score(estimate, held_out, prior, fleet.solve)
        blocks = scene_blocks(held_out)
        test = paired_test(score.cost(prior.of(pair)), score.cost(estimate.T), blocks)
        covariance = np.diag([*np.zeros(6), *score.extra_variance])
        covariance[:6, :6] = estimate.covariance
        update = held_out_update(score.derivatives, covariance, score.bias, blocks, limits)
    claims = claims_of(
        pair,
        estimate.T,
        estimate.covariance,
        update,
        float(np.radians(limit_deg)),
        verify.confidence,
        limits.held_out_contradiction_sigmas,
    )
    return test, claims


def _recorded(lake: Lake, partition: Partition, key: str) -> list[CalibrationRecord]:
    """What the same work has recorded already."""
    vehicle, day = partition.vehicle, partition.day
    records = read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=vehicle, day=day)
    return [r for r in records if r.work_key == key]


def _spread(observations: Sequence[Observation], selection: Selection) -> list[Observation]:
    """Frames that the triggers look at: those of the fit of all pairs, thinned."""
    rows = sorted(set().union(*selection.fit.values()))
    picked = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _TRIGGER_FRAMES)).astype(int))
    return [observations[rows[i]] for i in picked]


def _result(about: Inputs, records: Sequence[CalibrationRecord], status: str, lake: Lake) -> StageResult:
    counts = {s: sum(r.status == s for r in records) for s in ("accepted", "held", "refused")}
    all_refused = counts["refused"] == len(records)
    path = lake.folder(CALIBRATIONS.name, about.partition) / f"{about.work_key}.parquet"
    return StageResult(
        "calibrate",
        about.partition.vehicle,
        about.partition.day,
        "refused" if all_refused and status == "done" else status,
        about.work_key,
        rows=len(records),
        kept=counts,
        rejected=dict(records[0].frames_rejected) if records else {},
        reason="; ".join(f"{r.pair}: {r.reason}" for r in records if r.reason),
        outputs=[str(path)],
    )

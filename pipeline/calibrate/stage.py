"""Stage calibrate: observations of one vehicle-day to one calibration record per pair.

The only module that brings solve and verify together: select, trigger, solve, judge on held-out frames,
record.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np

from pipeline.calibrate.earlier import accepted_before
from pipeline.calibrate.methods import Method, Solver, method_named
from pipeline.calibrate.numerics.frame_blocks import scene_blocks
from pipeline.calibrate.numerics.search_range import search_range
from pipeline.calibrate.records import (
    Inputs,
    Judged,
    SolvedDay,
    record_of,
    refused_record,
    refused_records,
)
from pipeline.calibrate.select.frames import PAPER_SYNC_GATE_S, Selection, select_frames
from pipeline.calibrate.select.triggers import exceeded, trigger_metrics
from pipeline.calibrate.verify.day_checks import FoundDay, checks_of_day
from pipeline.calibrate.verify.held_out_score import held_out_score
from pipeline.calibrate.verify.held_out_test import HeldOutTest, paired_test
from pipeline.calibrate.verify.held_out_update import held_out_update
from pipeline.calibrate.verify.label_offset import with_label_offset
from pipeline.calibrate.verify.limits import VerdictLimits
from pipeline.calibrate.verify.motion_sources import MotionFindings, compared_sources
from pipeline.calibrate.verify.mounting import camera_turn_sigma_rad, mounting_covariance
from pipeline.calibrate.verify.seen_targets import seen_targets, unseen_failure, views_of
from pipeline.calibrate.verify.target_accuracy import Claim, claims_of
from pipeline.calibrate.verify.verdict import Evidence, judge
from pipeline.config import FleetConfig, VerifyConfig
from pipeline.errors import ConfigError, SolveError
from pipeline.extrinsics.checks import FailedCheck
from pipeline.extrinsics.estimates import PairEstimate, Prior, Solution
from pipeline.extrinsics.prior import day_prior, no_prior, perturbed, prior_key
from pipeline.geometry.targets import DEFAULT_TARGETS
from pipeline.results import Outcome, Progress, silent
from pipeline.rig.rig import Rig
from pipeline.store.moments import sensors_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import Manifest
from pipeline.store.views import ingested, observations_of, perceived
from pipeline.work import Records, Run, Task, Told, Work
from schemas.calibrations import (
    FRAMES_OF_PAIR,
    PAIRS,
    SENSORS,
    STATUSES,
    CalibrationRecord,
    pairs_of,
)
from schemas.moments import PRIOR, SENSORS_ABSENT
from schemas.observations import Observation
from schemas.poses import PoseRow

__all__ = ["calibrate_observations", "work"]

# Pairs that others are estimated with the help of: boxes are read through the camera, the camera's clock along the
# heading that the radar shows.
_HELPING = frozenset({"camera_lidar", "lidar_radar"})
_TRIGGER_FRAMES = 40  # metrics are means over frames: more of them only cost time


def work(task: Task) -> Work:
    """The records of a vehicle-day, one per pair.

    A day that cannot be calibrated gets refused records with the reason. So does a day that another stage refused:
    the task is given that stage's outcome, and the records say its reason.

    Raises:
        ConfigError: no such vehicle, method or network, or an impossible seed or prior file.
    """
    method, fleet = method_named(task.method or "joint"), task.fleet
    seed = fleet.solve.seed if task.seed is None else task.seed
    if seed < 0:
        raise ConfigError("command line", "seed", f"{seed} is less than 0")
    rig = fleet.rig_of(task.partition.vehicle)
    if task.given is not None:
        return _refusal(task.given, task.partition, method, seed, rig)
    settings = {"method": method.name} | method.settings_of(task)
    settings |= {
        "perturb": task.perturb,
        "seed": seed,
        "prior_file": prior_key(fleet, task.partition.vehicle),
        "camera": _known_cameras(rig),
    } | rig.told_to_calibrate
    prior = rig.prior
    tables = (ingested, perceived) if method.needs_images else (perceived,)
    manifests = [manifest_of(task.lake, task.partition) for manifest_of in tables]

    def rows(run: Run) -> Generator[Records, None, None]:
        absent = _absent(task.lake, task.partition)
        about = Inputs(
            task.partition, method.name, run.work_key, seed, run.inputs, pairs_of(rig.kinds), absent
        )
        records = _records if rig.is_one_of_each else _rig_records
        yield Records(records(task, method, about, run.progress))

    return Work(
        (fleet.select, fleet.trigger, fleet.solve, fleet.verify, prior, settings),
        rows,
        inputs=tuple(m.work_key for m in manifests if m is not None),
        tell=_told,
    )


def _records(task: Task, method: Method, about: Inputs, progress: Progress) -> list[CalibrationRecord]:
    """Of a day that can be calibrated or not."""
    fleet, prior, rows = task.fleet, None, list[Observation]()
    try:
        told, rows = _perceived(task.lake, task.partition)
        prior = day_prior(told.extra.get(PRIOR, ()), fleet, task.partition.vehicle)
        prior = perturbed(prior, task.perturb, about.seed)
        before = accepted_before(task.lake, task.partition, method.name)
        prior = replace(prior, T_camera_lidar_before=before)
        return calibrate_observations(rows, prior, fleet, about, progress, method.solver_of(task))
    except SolveError as err:
        return refused_records(about, err.reason, len(rows), prior, err.fault)


def _rig_records(
    task: Task, method: Method, about: Inputs, progress: Progress
) -> Sequence[CalibrationRecord | PoseRow]:
    """Of a rig of several sensors of a kind, or with a vehicle frame."""
    # It calibrates pairs by this module's means.
    from pipeline.calibrate.rig_stage import refused_edges, rig_rows, three_rows  # noqa: PLC0415

    try:
        if method.name == "joint":
            return rig_rows(task, about, progress)
        return three_rows(task, method, about, progress)
    except SolveError as err:
        return refused_edges(about, task.fleet.rig_of(task.partition.vehicle), err.reason, err.fault)


def _known_cameras(rig: Rig) -> dict[str, Any]:
    """What calibration takes as known of the rig's cameras, for the work key."""
    if rig.is_one_of_each:
        return {} if rig.camera is None else asdict(rig.camera.known)
    return {name: asdict(camera.known) for name, camera in rig.cameras.items()}


def _refusal(refused: Outcome, partition: Partition, method: Method, seed: int, rig: Rig) -> Work:
    """Records of a day that never reached the solver, so that whoever reads the lake finds the reason."""
    reason = f"{refused.stage}: {refused.reason}"

    def rows(run: Run) -> Generator[Records, None, None]:
        about = Inputs(partition, method.name, run.work_key, seed, run.inputs, pairs_of(rig.kinds))
        if rig.is_one_of_each:
            yield Records(refused_records(about, reason, 0, None, *refused.faults))
            return
        from pipeline.calibrate.rig_stage import refused_edges  # noqa: PLC0415 - as in _rig_records

        yield Records(refused_edges(about, rig, reason, *refused.faults))

    inputs = (refused.work_key,) if refused.work_key else ()
    # Recorded each time: an older record of a day that was not refused then must not pass for the current one.
    return Work(({"refused": reason, "method": method.name},), rows, inputs, tell=_told, again=True)


def calibrate_observations(
    observations: Sequence[Observation],
    prior: Prior,
    fleet: FleetConfig,
    about: Inputs,
    progress: Progress = silent,
    solver: Solver | None = None,
) -> list[CalibrationRecord]:
    """Select, trigger, solve, judge: the records of one day, without writing anything; each pair by its own frames.

    `solver` is for methods that need more than observations (`Method.needs_images`); None = the method's own.

    Raises:
        SolveError: the day cannot be calibrated.
    """
    return calibrate_day(observations, prior, fleet, about, progress, solver)[0]


def calibrate_day(
    observations: Sequence[Observation],
    prior: Prior,
    fleet: FleetConfig,
    about: Inputs,
    progress: Progress = silent,
    solver: Solver | None = None,
) -> tuple[list[CalibrationRecord], SolvedDay | None]:
    """`calibrate_observations`, and the solved day behind the records; None where every pair was refused.

    Raises:
        SolveError: the day cannot be calibrated.
    """
    motion = compared_sources(observations, prior.T_lidar_radar)
    try:
        return _solved(observations, prior, fleet, about, motion, progress, solver)
    except SolveError as err:
        raise _named(err, motion.wrong) from err


def _named(refusal: SolveError, wrong: Sequence[FailedCheck]) -> SolveError:
    """A refusal that says first which source of motion is wrong, where one is."""
    if not wrong:
        return refusal
    return SolveError("; ".join([*(check.sentence for check in wrong), refusal.reason]), wrong[0].fault)


def _solved(
    observations: Sequence[Observation],
    prior: Prior,
    fleet: FleetConfig,
    about: Inputs,
    motion: MotionFindings,
    progress: Progress,
    solver: Solver | None,
) -> tuple[list[CalibrationRecord], SolvedDay | None]:
    """The records of a day whose sources of motion were compared."""
    progress(0, 4, "select frames")
    method, select = method_named(about.method), fleet.select
    if method.frames == "all":
        select = select.model_copy(update={"frames": max(len(observations), 1)})
    sync_gate_s, by_motion = _sync_gate_s(method, fleet), fleet.ingest
    selection = select_frames(
        observations,
        select,
        paper=method.paper_selection,
        sync_gate_s=sync_gate_s,
        motion_gate=None
        if sync_gate_s
        else (by_motion.sync_gate_m, float(np.radians(by_motion.sync_gate_deg))),
        pairs=about.pairs,
        absent=about.absent,
    )
    refused = {p: _named(e, motion.of(p)) for p, e in _refused(method, about.pairs, selection, prior).items()}
    pairs = [pair for pair in about.pairs if pair not in refused]
    refusals = {
        pair: refused_record(about, pair, why, observations, prior, selection.rejected[pair])
        for pair, why in refused.items()
    }
    if not pairs:
        return list(refusals.values()), None
    frames = {pair: [observations[i] for i in selection.fit[pair]] for pair in pairs}
    sample = _spread(observations, frames)
    before = trigger_metrics(sample, {pair: prior.of(pair) for pair in pairs})
    fired = {pair: exceeded(before[pair], fleet.trigger) for pair in pairs}
    active = _to_calibrate(method, fired, fleet.trigger.when)
    progress(1, 4, f"solve by {about.method}")
    solution = (solver or method.solver())(
        frames,
        prior,
        fleet.solve,
        seed=about.seed,
        triggered=active,
        progress=lambda done, total, what: progress(1, 4, f"{what} ({done}/{total})"),
    )
    if "camera_lidar" in active:
        solution = with_label_offset(solution, observations)
    progress(2, 4, "judge on held-out frames")
    solution, judged = _believed(
        solution,
        lambda found: _judge_all(observations, selection, prior, found, fleet, active, motion),
        active,
    )
    after = trigger_metrics(sample, {pair: solution.pairs[pair].T for pair in pairs})
    day = SolvedDay(
        observations,
        selection,
        prior,
        solution,
        judged,
        before,
        after,
        {pair: bool(fired[pair]) for pair in pairs},
        motion.numbers,
    )
    progress(4, 4, "done")
    records = [refusals[pair] if pair in refusals else record_of(about, pair, day) for pair in about.pairs]
    return records, day


def _absent(lake: Lake, partition: Partition) -> dict[str, str]:
    """Why frames lack a sensor, by the manifests of perceive and of ingest, which says more."""
    told, told_before = perceived(lake, partition), ingested(lake, partition)
    found, counts = {}, {} if told is None else told.rejected
    for sensor in SENSORS if told is None else (*SENSORS, *sensors_of(told)):
        own = {name: n for name, n in counts.items() if name.startswith(f"without_{sensor}_")}
        if own:
            most = max(own, key=lambda name: own[name])
            found[sensor] = f"most often {most.removeprefix(f'without_{sensor}_')}, {own[most]} times"
    for manifest in (told_before, told):
        found |= {} if manifest is None else manifest.extra.get(SENSORS_ABSENT, {})
    return found


def _refused(
    method: Method, pairs: Sequence[str], selection: Selection, prior: Prior
) -> dict[str, SolveError]:
    """Pairs that the day cannot calibrate: too few frames, no prior, or a method that needs what is missing."""
    refused = dict(selection.refused)
    refused |= {p: SolveError(no_prior(p)) for p in pairs if p not in refused and not prior.knows(p)}
    if method.needs_all and (refused or len(pairs) < len(PAIRS)):
        missing = [s for s in SENSORS if not any(s in FRAMES_OF_PAIR[p] for p in pairs)]
        why = f"the rig has no {missing[0]}" if missing else next(iter(refused.values())).reason
        alone = SolveError(f"method {method.name} needs camera, lidar and radar: {why}")
        refused = {pair: refused.get(pair, alone) for pair in pairs}
    return {pair: refused[pair] for pair in pairs if pair in refused}


def _believed(
    solution: Solution, judge_all: Callable[[Solution], dict[str, Judged]], active: Sequence[str]
) -> tuple[Solution, dict[str, Judged]]:
    """The solution in which nothing rests on a pair that is not accepted, and its verdicts.

    Pairs that help others and are not accepted are taken out, and what rested on them is solved and judged again; that
    can cost another pair its acceptance, so again, until no more has to go.
    """
    judged, disbelieved = judge_all(solution), frozenset[str]()
    while solution.without is not None:
        held = {pair for pair in active if judged[pair].verdict.status != "accepted"}
        more = disbelieved | (held & _HELPING)
        if more == disbelieved:
            break
        disbelieved = more
        solution = solution.without(disbelieved)
        judged = judge_all(solution)
    return solution, judged


def _sync_gate_s(method: Method, fleet: FleetConfig) -> float | None:
    """The gate of ingest; where that is by motion, the paper's methods, which know of none, keep the paper's."""
    gate_s = fleet.ingest.sync_gate_s
    return PAPER_SYNC_GATE_S if gate_s is None and method.paper_selection else gate_s


def _to_calibrate(method: Method, fired: Mapping[str, Sequence[str]], when: str) -> list[str]:
    """Pairs to estimate and to judge: all, or those with a metric beyond its threshold.

    A composed pair is as good as its factors: where it is asked for, so are they.
    """
    wanted = {p for p in fired if fired[p] or when == "always"}
    if wanted & set(_composed_of(method, fired)):
        wanted = set(fired)
    return [p for p in fired if p in wanted]


def _composed_of(method: Method, pairs: Collection[str]) -> tuple[str, ...]:
    """Pairs that the method composes of the others: none where one of these is missing."""
    return method.composed if len(pairs) == len(PAIRS) else ()


def _perceived(lake: Lake, partition: Partition) -> tuple[Manifest, list[Observation]]:
    told = perceived(lake, partition)
    if told is None:
        raise SolveError("no observations of this day: ingest or perceive refused it, or did not run")
    return told, list(observations_of(lake, partition))


def _judge_all(
    observations: Sequence[Observation],
    selection: Selection,
    prior: Prior,
    solution: Solution,
    fleet: FleetConfig,
    active: Sequence[str],
    motion: MotionFindings,
) -> dict[str, Judged]:
    """Verdict and evidence of each pair; pairs that a method composes come after their factors."""
    limits, search = _limits(fleet.verify), search_range(prior, fleet.solve)
    composed = _composed_of(method_named(solution.method), solution.pairs)
    seen_by = next((o for o in observations if "camera" in o.sensors), None)
    turn = None if seen_by is None else camera_turn_sigma_rad(solution, prior.camera, seen_by.camera_K)
    about = FoundDay(observations, selection, prior, solution, composed, fleet, limits, motion)
    failed = checks_of_day(about)
    found: dict[str, Judged] = {}
    views = views_of(observations)
    for pair in sorted(solution.pairs, key=lambda p: p in composed):
        estimate = solution.pairs[pair]
        held_out = [observations[i] for i in selection.holdout[pair]] if pair in active else []
        mounting = mounting_covariance(pair, estimate.T, estimate.covariance, turn)
        targets = seen_targets(pair, prior, views)
        unseen = [] if targets is not None else [unseen_failure(pair)]
        targets = DEFAULT_TARGETS if targets is None else targets
        test, claims = _held_out_evidence(estimate, held_out, prior, fleet, limits, mounting, targets)
        verdict = judge(
            estimate,
            prior,
            Evidence(test, claims, [*failed[pair], *unseen]),
            search,
            limits,
            triggered=pair in active,
            factors=tuple(f.verdict for f in found.values()) if pair in composed else (),
        )
        found[pair] = Judged(verdict, test, claims, mounting, targets)
    return found


def _limits(verify: VerifyConfig) -> VerdictLimits:
    """The thresholds that `[verify]` of fleet.toml names as the verdict does."""
    return VerdictLimits(**{f.name: getattr(verify, f.name) for f in fields(VerdictLimits)})


def _held_out_evidence(
    estimate: PairEstimate,
    held_out: Sequence[Observation],
    prior: Prior,
    fleet: FleetConfig,
    limits: VerdictLimits,
    mounting: np.ndarray | None,
    targets: np.ndarray,
) -> tuple[HeldOutTest | None, dict[str, Claim]]:
    """Held-out frames at the prior and at the result, and what they leave to claim."""
    pair, verify = estimate.pair, fleet.verify
    azimuth_deg, elevation_deg = (
        (verify.camera_lidar_limit_deg, verify.camera_lidar_limit_deg)
        if pair == "camera_lidar"
        else (verify.radar_limit_deg, verify.radar_elevation_limit_deg)
    )
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
        float(np.radians(azimuth_deg)),
        verify.confidence,
        limits.held_out_contradiction_sigmas,
        float(np.radians(elevation_deg)),
        mounting,
        targets,
    )
    return test, claims


def _spread(
    observations: Sequence[Observation], frames: Mapping[str, Sequence[Observation]]
) -> list[Observation]:
    """Frames that the triggers look at: those of the fit of all pairs, thinned."""
    used = {id(o) for own in frames.values() for o in own}
    rows = [o for o in observations if id(o) in used]
    picked = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _TRIGGER_FRAMES)).astype(int))
    return [rows[i] for i in picked]


def _told(records: Sequence[CalibrationRecord]) -> Told:
    counts = {status: sum(r.status == status for r in records) for status in STATUSES}
    return Told(
        counts,
        dict(records[0].frames_rejected) if records else {},
        "; ".join(f"{r.pair}: {r.reason}" for r in records if r.reason),
        refused=counts["refused"] == len(records),
        faults=tuple(dict.fromkeys(fault for r in records for fault in r.faults)),
    )

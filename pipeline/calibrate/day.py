"""A day of one camera, one lidar and one radar, or two of them: select, trigger, solve, judge on held-out frames."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from pipeline.calibrate.adjust.equations import evidence_of
from pipeline.calibrate.adjusted_day import SolvedDay, SolvedEdge
from pipeline.calibrate.judging import Judged, Judging
from pipeline.calibrate.methods import Method, Solver, method_named
from pipeline.calibrate.reasons import because
from pipeline.calibrate.records import Inputs, edge_of_pair, record_of, refused_record
from pipeline.calibrate.select.frames import PAPER_SYNC_GATE_S, Selection, select_frames
from pipeline.calibrate.select.triggers import exceeded, trigger_metrics
from pipeline.calibrate.verify.day_checks import FoundDay, checks_of_day
from pipeline.calibrate.verify.day_labels import day_labels
from pipeline.calibrate.verify.motion_sources import MotionFindings, compared_sources
from pipeline.calibrate.verify.target_accuracy import camera_turn_sigma_rad
from pipeline.core.config import FleetConfig
from pipeline.core.errors import SolveError
from pipeline.core.results import Progress, silent
from pipeline.core.stage_work import Probes
from pipeline.rig.day_prior import no_prior
from pipeline.rig.estimates import Check, Prior, Solution
from schemas.calibrations import FRAMES_OF_PAIR, PAIRS, SENSORS, CalibrationRecord
from schemas.faults import FAULTS
from schemas.observations import WITHOUT_LABELS, Observation

__all__ = ["solve_day", "unlabelled_pairs"]

_TRIGGER_FRAMES = 40  # metrics are means over frames: more of them only cost time


def solve_day(
    observations: Sequence[Observation], prior: Prior, fleet: FleetConfig, about: Inputs,
    progress: Progress = silent, solver: Solver | None = None,
) -> tuple[list[CalibrationRecord], list[SolvedEdge]]:  # fmt: skip
    """Select, trigger, solve, judge, each pair by its own frames: records of refused pairs, and the others.

    `solver` is for methods that need more than observations (`Method.needs_images`); None = the method's own.

    Raises:
        SolveError: the day cannot be calibrated.
    """
    motion = compared_sources(observations, prior.T_ahead_radar)
    try:
        return _solved(observations, prior, fleet, about, motion, progress, solver)
    except SolveError as err:
        raise _named(err, motion.wrong) from err


def _named(refusal: SolveError, wrong: Sequence[Check]) -> SolveError:
    """A refusal whose reason begins with a wrong source of motion, if there is one."""
    if not wrong:
        return refusal
    return SolveError("; ".join([*(check.sentence for check in wrong), refusal.reason]), wrong[0].fault)


def _solved(
    observations: Sequence[Observation], prior: Prior, fleet: FleetConfig, about: Inputs,
    motion: MotionFindings, progress: Progress, solver: Solver | None,
) -> tuple[list[CalibrationRecord], list[SolvedEdge]]:  # fmt: skip
    """A day whose sources of motion were compared."""
    progress(0, 4, "select frames")
    labels = day_labels(observations, float(np.radians(fleet.verify.camera_lidar_limit_deg)))
    observations = observations if labels is None else labels.in_place(observations)
    method = method_named(about.method)
    selection = _selection(observations, method, fleet, about)
    unlabelled = unlabelled_pairs(observations, about.chosen, needs_labels=method.needs_labels)
    known = {**selection.refused, **unlabelled}  # no frames are enough for pairs that need labels
    refused = {p: _named(e, motion.of(p)) for p, e in _refused(method, about.pairs, known, prior).items()}
    pairs = [pair for pair in about.pairs if pair not in refused]
    refusals = [
        refused_record(about, pair, why, observations, prior, selection.rejected[pair])
        for pair, why in refused.items()
    ]
    if not pairs:
        return refusals, []
    frames = {pair: [observations[i] for i in selection.fit[pair]] for pair in pairs}
    sample, before, fired = _triggers(observations, frames, prior, method, fleet)
    active = _to_calibrate(method, fired, fleet.trigger.when)
    progress(1, 4, f"solve by {about.method}")
    solution = (solver or method.solver())(
        frames, prior, fleet.solve, seed=about.seed, triggered=active,
        progress=lambda done, total, what: progress(1, 4, f"{what} ({done}/{total})"),
    )  # fmt: skip
    if labels is not None and "camera_lidar" in active:
        solution = labels.judged(solution)
    progress(2, 4, "judge on held-out frames")
    failed, judging = _judging(
        observations, selection, prior, solution, fleet, active, motion, about.probe_deg
    )
    judged = _judged(solution, failed, judging, method.composed if len(pairs) == len(PAIRS) else ())
    doubted = {pair: estimate.doubted(judged[pair].doubt) for pair, estimate in solution.pairs.items()}
    day = SolvedDay(
        observations, selection, prior, replace(solution, pairs=doubted), judged, failed, judging, sample,
        before, {pair: bool(fired[pair]) for pair in pairs}, motion.numbers,
    )  # fmt: skip
    progress(4, 4, "done")
    return refusals, [_edge(day, about, pair) for pair in day.solution.pairs]


def _edge(day: SolvedDay, about: Inputs, pair: str) -> SolvedEdge:
    own, judged, edge = day.solution.pairs[pair], day.judged[pair], edge_of_pair(about, pair)
    clock_sigma_s = day.judging.fleet.solve.time_offset_sigma_s
    return SolvedEdge(
        edge, own, judged, evidence_of(own, edge, day.prior, clock_sigma_s, judged.verdict.against),
        tuple(day.failed[pair]), day.judging.pair, partial(record_of, about, pair, day),
        is_active=pair in day.judging.active,
    )  # fmt: skip


def _triggers(
    observations: Sequence[Observation],
    frames: Mapping[str, Sequence[Observation]],
    prior: Prior,
    method: Method,
    fleet: FleetConfig,
) -> tuple[list[Observation], Mapping[str, Mapping[str, float]], dict[str, list[str]]]:
    """Frames that trigger metrics are measured on, if they are; the metrics at the prior, and what they exceed."""
    measured = method.paper_selection or fleet.trigger.when == "triggered"
    sample = _spread(observations, frames) if measured else []
    before = trigger_metrics(sample, {pair: prior.of(pair) for pair in frames})
    fired = {pair: exceeded(metrics, fleet.trigger) for pair, metrics in before.items()}
    if "camera_lidar" in fired and any(o.is_unlabelled for o in sample):
        fired["camera_lidar"] = [WITHOUT_LABELS]  # nothing shows that it need not be calibrated
    return sample, before, fired


def _selection(
    observations: Sequence[Observation], method: Method, fleet: FleetConfig, about: Inputs
) -> Selection:
    """Frames to fit and frames to judge, of each pair, within the method's limit of stamp differences."""
    select, gates, gate_s = fleet.select, fleet.ingest, fleet.ingest.sync_gate_s
    if method.frames == "all":
        select = select.model_copy(update={"frames": max(len(observations), 1)})
    if gate_s is None and method.paper_selection:
        gate_s = PAPER_SYNC_GATE_S
    return select_frames(
        observations, select, paper=method.paper_selection, sync_gate_s=gate_s,
        motion_gate=None if gate_s else (gates.sync_gate_m, float(np.radians(gates.sync_gate_deg))),
        pairs=about.pairs, absent=about.absent,
    )  # fmt: skip


def _judging(
    observations: Sequence[Observation], selection: Selection, prior: Prior, solution: Solution,
    fleet: FleetConfig, active: Sequence[str], motion: MotionFindings, probe_deg: Probes,
) -> tuple[Mapping[str, Sequence[Check]], Judging]:  # fmt: skip
    """Failed checks of all pairs, and inputs of their verdicts."""
    seen_by = next((o for o in observations if "camera" in o.sensors), None)
    turn = None if seen_by is None else camera_turn_sigma_rad(solution, prior.camera, seen_by.camera_K)
    about = FoundDay(observations, selection, prior, solution, fleet, fleet.verify.checks, motion)
    judging = Judging(observations, selection, prior, fleet, active, turn, probe_deg)
    return checks_of_day(about), judging


def _judged(
    solution: Solution, failed: Mapping[str, Sequence[Check]], judging: Judging, composed: Collection[str]
) -> dict[str, Judged]:
    """Verdicts of all pairs; those that the method composes after their factors, which they are as good as."""
    judged: dict[str, Judged] = {}
    for pair in sorted(solution.pairs, key=lambda p: p in composed):
        checks = list(failed[pair])
        held = [j.verdict for j in judged.values() if j.verdict.status != "accepted"]
        if pair in composed and held:
            disproved = any(v.disproved for v in held)
            checks.append(Check(because("composed"), disproves=disproved))
        judged[pair] = judging.pair(solution.pairs[pair], checks, pair in composed)
    return judged


def _refused(
    method: Method, pairs: Sequence[str], known: Mapping[str, SolveError], prior: Prior
) -> dict[str, SolveError]:
    """Pairs that the day cannot calibrate: those known, no prior, or a method that needs what is missing."""
    refused = dict(known)
    refused |= {p: SolveError(no_prior(p)) for p in pairs if p not in refused and not prior.knows(p)}
    if method.needs_all and (refused or len(pairs) < len(PAIRS)):
        missing = [s for s in SENSORS if not any(s in FRAMES_OF_PAIR[p] for p in pairs)]
        why = because("lacks", kind=missing[0]) if missing else next(iter(refused.values())).reason
        alone = SolveError(because("needs all", method=method.name, why=why))
        refused = {pair: refused.get(pair, alone) for pair in pairs}
    return {pair: refused[pair] for pair in pairs if pair in refused}


def _to_calibrate(method: Method, fired: Mapping[str, Sequence[str]], when: str) -> list[str]:
    """Pairs to estimate and to judge: all, or those with a metric beyond its threshold.

    Camera-radar depends on the other two pairs, so it includes them.
    """
    wanted = {p for p in fired if fired[p] or when == "always"}
    if "camera_radar" in wanted and (method.composed or method.name == "joint"):
        wanted = set(fired)
    return [p for p in fired if p in wanted]


def _spread(
    observations: Sequence[Observation], frames: Mapping[str, Sequence[Observation]]
) -> list[Observation]:
    """Frames that the triggers look at: those of the fit of all pairs, thinned."""
    used = {id(o) for own in frames.values() for o in own}
    rows = [o for o in observations if id(o) in used]
    picked = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _TRIGGER_FRAMES)).astype(int))
    return [rows[i] for i in picked]


def unlabelled_pairs(
    observations: Sequence[Observation], chosen: Mapping[str, str], *, needs_labels: bool
) -> dict[str, SolveError]:
    """Pairs of a camera without semantics that need labels or road users, and why they are refused.

    `chosen` has the names of the sensors by kind. Camera-radar compares moving clusters with the boxes of road
    users. Camera-lidar can do with steps of brightness, unless the method `needs_labels`.
    """
    if not any(o.is_unlabelled for o in observations):
        return {}
    camera = chosen.get("camera", "camera")
    why = {"camera_radar": "boxes of road users"} | ({"camera_lidar": "labels"} if needs_labels else {})
    found = {"fault": FAULTS["no_labels"], "camera": camera}
    return {
        pair: SolveError(because("no labels", **found, pair=pair.replace("_", "-"), what=what), "no_labels")
        for pair, what in why.items()
    }

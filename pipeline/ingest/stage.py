"""Stage ingest: from the logs of one vehicle-day to its moments and a file of each sensor."""

from __future__ import annotations

import datetime as dt
from collections import Counter
from collections.abc import Generator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int64

from pipeline.core.config import FleetConfig, IngestConfig
from pipeline.core.errors import ConfigError
from pipeline.core.stage_work import NothingUsable, Run, Task, Work
from pipeline.ingest.containers.reader import content_identity, leads_nowhere
from pipeline.ingest.index import DayIndex, index_logs
from pipeline.ingest.messages.radar import CORRECT_FIELD
from pipeline.ingest.moments import REPEATED, Anchored, MomentBuilder, spread
from pipeline.ingest.readiness import Unheard, unheard_topics
from pipeline.ingest.reasons import because
from pipeline.ingest.roles import NEEDED, topics_of
from pipeline.ingest.sync import WRONG_UNIT, Matched, Rejection, match_moments, none_near, number_drives
from pipeline.objective.stamp_gaps import motion_gates_ns
from pipeline.rig.day_prior import read_star
from pipeline.rig.graph import possible_edges
from pipeline.rig.prior import Star
from pipeline.rig.rig import Rig
from schemas.captures import Capture
from schemas.faults import FAULTS
from schemas.moments import (
    PRIOR,
    SENSORS_ABSENT,
    STATED_FAULTS,
    SWEEPS_LOGGED,
    SWEEPS_PLANNED,
    SWEEPS_READ,
    TF,
    Moment,
)

__all__ = ["pick_moments", "read_file_prior", "work"]

_PROBLEMS_SHOWN = 3
# Rejections that state a fault.
_STATED = dict.fromkeys(REPEATED.values(), "stuck_sensor") | dict.fromkeys(WRONG_UNIT.values(), "unit")
_FAR_FROM_DAY = dt.timedelta(hours=12 + 14 + 12)  # half a day, the earliest time zone, and a drive at night
_USABLE = {Rejection.DUPLICATE_STAMP, Rejection.NO_LIDAR, Rejection.NOT_PICKED}
_UNUSABLE = [r for r in Rejection if r not in _USABLE]  # what a sensor gave was of no use


def work(task: Task) -> Work:
    """Moments in the task's logs, and the captures of each sensor.

    A day without a moment of two sensors is refused and nothing is written: an empty table would look like a
    processed day without data. A partition of earlier inputs stays, and the reason names topics and the
    remedy. `rejected` counts each sweep that became no moment under one reason; damage, dropped points and
    missing parts have counts of their own.

    Raises:
        ConfigError: unknown vehicle, a log that does not exist, an unusable prior file.
        LogError: a log that cannot be read, or a link whose target is not there.
    """
    rig = task.fleet.rig_of(task.partition.vehicle)
    missing = [str(p) for p in task.logs if not p.exists() and not leads_nowhere(p)]
    if missing:
        raise ConfigError("command line", "LOG", f"no such file: {', '.join(missing)}")
    file_prior = read_file_prior(rig, task.fleet)
    prior_key = (
        {} if file_prior is None else {"prior": [[*ends, T.tolist()] for ends, T in file_prior.items()]}
    )
    config = task.fleet.ingest
    wider = (config.wider, config.wider.wider)  # settings of a night that reads more of a long day
    return Work(
        (config, rig, prior_key),
        lambda run: _rows(task, rig, file_prior, run),
        inputs=tuple(sorted(content_identity(p) for p in task.logs)),
        wider=() if config.read_budget is None else tuple((c, rig, prior_key) for c in wider),
    )


def _rows(
    task: Task, rig: Rig, file_prior: Star | None, run: Run
) -> Generator[tuple[Moment, dict[str, Capture]], None, None]:
    """Moments of the day in order of time, one at a time."""
    config = task.fleet.ingest
    run.progress(0, 0, "reading the index")
    index = index_logs(task.logs, rig, budget=config.read_budget)
    try:
        unheard = unheard_topics(index, rig)
        # first, because of many problems only some are shown
        index.problems[:0] = [str(u) for u in unheard if u.is_misconfigured]
        index.problems += [str(u) for u in unheard if not u.is_misconfigured]
        builder = MomentBuilder(index, rig, config, file_prior)
        anchored, rejected = pick_moments(index, rig, config)
        made = 0
        for made, row in enumerate(builder.built(anchored, rejected, run.progress), 1):  # noqa: B007
            yield row
        counts = rejected + index.damage + builder.counts
        run.rejected.update({str(k): int(v) for k, v in counts.items() if v})
        run.kept.update(_reading_counts(index))
        if not made:
            raise NothingUsable(*_refusal(index, rig, rejected, config, unheard))
        _complain_of_date(index, task.partition.day)
        run.extra |= {
            "problems": index.problems,
            "logs": index.log_names,
            "frame_ids": builder.prior.frame_ids,
        }
        run.extra[PRIOR] = builder.prior.rows()
        run.extra[TF] = builder.prior.frames_above()
        run.extra[SENSORS_ABSENT] = _absences(index, rig, builder.counts, config, unheard)
        mistaken = any(u.is_misconfigured for u in unheard) or any(
            p.endswith(CORRECT_FIELD) for p in index.problems
        )
        run.extra[STATED_FAULTS] = ["configuration"] if mistaken else []
        run.remarks = _shorten(index.problems)
    finally:
        index.close()


def _complain_of_date(index: DayIndex, day: str) -> None:
    """Report a day whose sweeps have another date, but for time zones and drives over midnight."""
    stamps_ns = index.captures(index.anchor).stamps_ns
    stamped = dt.datetime.fromtimestamp(float(np.median(stamps_ns)) * 1e-9, dt.UTC)
    if abs(stamped - dt.datetime.fromisoformat(f"{day}T12:00+00:00")) > _FAR_FROM_DAY:
        index.complain(because("other date", stamped=stamped, day=day))


def pick_moments(index: DayIndex, rig: Rig, config: IngestConfig) -> tuple[list[Anchored], Counter[str]]:
    """Captures by moment, in order of time, at most `max_frames`; and unused sweeps by reason."""
    found, anchors = _find_moments(index, rig, config), index.captures(index.anchor)
    drives = number_drives(anchors.stamps_ns, [at.log for at in anchors.located])
    picked = spread(len(found.anchor), config.max_frames)
    places = {index.anchor: found.anchor, **found.others}
    anchored = [
        Anchored({s: int(at[i]) for s, at in places.items() if at[i] >= 0}, int(drives[found.anchor[i]]))
        for i in picked
    ]
    return anchored, +(found.rejected + Counter({Rejection.NOT_PICKED: len(found.anchor) - len(picked)}))


def _find_moments(index: DayIndex, rig: Rig, config: IngestConfig) -> Matched:
    """All moments of the day, or of its bursts, within the configured gate.

    Moments are built about the sweeps of the first lidar; without any sweep, about the first radar's scans.
    """
    wanted = index.sweeps_in_bursts()
    anchors_ns = index.captures(index.anchor).stamps_ns[wanted]
    others_ns = {s: index.captures(s).stamps_ns for s in index.kinds if s != index.anchor}
    tied = _tied(rig, index.anchor)
    if config.sync_gate_s is not None:
        gate_ns: int | Int64[np.ndarray, " N"] = round(config.sync_gate_s * 1e9)
    else:
        turn_rad = float(np.radians(config.sync_gate_deg))
        gate_ns = motion_gates_ns(*index.ego.motion_at(anchors_ns), config.sync_gate_m, turn_rad)
    found = match_moments(anchors_ns, others_ns, gate_ns, tied)
    return replace(found, anchor=wanted[found.anchor])


def _tied(rig: Rig, anchor: str) -> set[str] | None:
    """Sensors that can have an edge to the anchor, also through the vehicle frame; None for one of each kind."""
    sensors = [node for node in rig.nodes if node.kind != "base"]
    if len({node.kind for node in sensors}) == len(sensors):
        return None
    ends = [{s.name for s in edge.sensors} for edge in possible_edges(sensors)]
    return {s.name for s in sensors if rig.base is not None or {s.name, anchor} in ends}


def _refusal(
    index: DayIndex, rig: Rig, rejected: Counter[str], config: IngestConfig, unheard: Sequence[Unheard]
) -> tuple[str, ...]:
    """Reason why a day gives no frame, with topic and remedy; then the faults that it states."""
    topics = {role: topic for topic, role in topics_of(rig).items() if role.is_capture}
    absent = [role for role in topics if not index.captures(role.sensor).stamps]
    faults: tuple[str, ...] = ()
    if any(u.is_misconfigured and u.role.what in NEEDED for u in unheard):
        return _shorten(index.problems), "configuration"
    if len(topics) - len(absent) < 2:
        what = because("nothing", topics=", ".join(f"{topics[role]} ({role})" for role in absent))
        faults = ("configuration",) if index.types_beside else ()  # no message at all is no fault of topics
    elif not set(rejected) & set(_UNUSABLE):
        of = {"camera": "an image", "lidar": "a sweep", "radar": "a scan"}
        met = " and ".join(f"{of[r.kind]} of {topic}" for r, topic in topics.items() if r not in absent)
        what = because("apart", messages=met, near=_near_enough(config))
    else:
        reason = max(_UNUSABLE, key=lambda r: rejected[r])
        what = because("unusable", cause=reason, times=rejected[reason])
        if reason in _STATED:
            what, faults = f"{FAULTS[_STATED[reason]]}: {what}", (_STATED[reason],)
    return _shorten([what, *index.problems]), *faults


def _absences(
    index: DayIndex, rig: Rig, counts: Counter[str], config: IngestConfig, unheard: Sequence[Unheard]
) -> dict[str, str]:
    """By missing sensor, the reason, with topic and remedy."""
    found = {}
    of_sensor = {u.role.sensor: str(u) for u in unheard if u.role.what in NEEDED and u.is_misconfigured}
    for topic, role in topics_of(rig).items():
        if not role.is_capture:
            continue
        sensor, kind = role.sensor, role.kind
        near = none_near(kind)
        own = Counter({r: counts[f"without_{sensor}_{r}"] for r in (*Rejection, near)})
        reason, count = own.most_common(1)[0]
        if not count:
            continue
        if sensor in of_sensor:
            found[sensor] = of_sensor[sensor]
        elif not index.captures(sensor).stamps:
            found[sensor] = because("nothing", topics=f"{topic} ({role})")
        elif reason == near:
            found[sensor] = because("none near", topic=topic, near=_near_enough(config))
        else:
            stated = f"{FAULTS[_STATED[reason]]}: " if reason in _STATED else ""
            why = next((p for p in index.problems if p.startswith(f"{reason}: ")), reason)
            found[sensor] = stated + because("sensor unusable", topic=topic, cause=why, times=count)
    return found


def _near_enough(config: IngestConfig) -> str:
    """The gate in words, and the remedy if no capture is within it."""
    if config.sync_gate_s is not None:
        return because("gate", ms=config.sync_gate_s * 1e3)
    return because("motion gate", m=config.sync_gate_m, deg=config.sync_gate_deg)


def read_file_prior(rig: Rig, fleet: FleetConfig) -> Star | None:
    """Transforms of a prior file; None if the prior comes from static transforms."""
    return None if rig.prior.file is None else read_star(fleet.path_of(rig.prior.file), rig)


def _reading_counts(index: DayIndex) -> dict[str, int]:
    """For a day read in bursts: numbers of sweeps in the logs, in the plan, and read."""
    if index.reading is None:
        return {}
    read = len(index.sweeps_in_bursts())
    return {SWEEPS_LOGGED: index.reading.sweeps, SWEEPS_PLANNED: index.reading.planned, SWEEPS_READ: read}


def _shorten(problems: list[str]) -> str:
    problems = list(dict.fromkeys(problems))
    more = len(problems) - _PROBLEMS_SHOWN
    return "; ".join(problems[:_PROBLEMS_SHOWN]) + (f"; and {more} more" if more > 0 else "")

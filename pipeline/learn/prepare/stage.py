"""Stage prepare: frames and observations of a vehicle-day to table `training`, a row group at a time.

A fleet is prepared in three steps: survey all days (`survey_day`: a few plain columns), divide them
(`plan_days`), and write each day on any worker (`work`): no row depends on another day's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.core.errors import SolveError
from pipeline.core.stage_work import Run, Task, Work
from pipeline.learn.prepare.sides import frame_sides, split_rule
from pipeline.learn.prepare.split import SplitPlan, Unit
from pipeline.learn.prepare.survey import Survey, reference_of, survey_day, usable_records
from pipeline.learn.sample.frame_sample import About, SampleReason, SampleRejectedError, make_row
from pipeline.rig.day_prior import prior_key, read_prior
from pipeline.store.views import Chosen, frames_of, observations_of
from schemas.calibrations import PAIRS, SENSORS, CalibrationRecord
from schemas.observations import Observation
from schemas.training import SAMPLED, TrainingRow

__all__ = ["work"]

_SAME = 1e-6  # rad and m: logged priors repeat numbers, they do not measure


def work(task: Task) -> Work:
    """Samples of a vehicle-day, divided by the task's `SplitPlan`; ConfigError if rig or prior are unusable."""
    config, plan, vehicle = task.fleet.prepare, task.given, task.partition.vehicle
    rig = task.fleet.rig_of(vehicle)
    prior, chosen = rig.prior, rig.one_of_each("training")
    survey = survey_day(task.partition, task.lake, config)
    sides, rejected = frame_sides(survey, plan, config)
    records = usable_records(task.lake, task.partition, chosen)
    settings: dict[str, Any] = {
        "prior_file": prior_key(task.fleet, vehicle), "sides": [s or "" for s in sides],
        "joint": {pair: row.work_key for pair, row in records.items()},
    }  # fmt: skip
    settings |= {} if rig.three is None else {"three": rig.three}
    about = _about(survey, task.fleet.vehicle(vehicle).rig, sides)
    extra = {
        "split_rule": split_rule(config), "sides": _sides_given(survey, plan), SAMPLED: chosen,
        "grid": {"step_deg": config.grid.step_deg, "shape": list(config.grid.shape)},
    }  # fmt: skip

    def rows(run: Run) -> Generator[TrainingRow, None, None]:
        run.rejected.update(rejected)
        run.extra |= extra
        for seen, row in enumerate(_samples(task, about, chosen, records, run.rejected), 1):
            run.progress(seen, len(about), "prepare")
            if row is not None:
                run.kept.update((row.split, f"{row.split} {row.environment}"))
                yield row

    return Work((config, prior, settings), rows, nothing="no sample")


def _about(survey: Survey, rig: str, sides: Sequence[str | None]) -> dict[int, About]:
    """Facts of each kept frame, by row of table frames."""
    vehicle, day = survey.partition.vehicle, survey.partition.day
    told = zip(sides, survey.place, survey.environment, strict=True)
    return {
        row: About(vehicle, day, rig, side, place, environment)
        for row, (side, place, environment) in enumerate(told)
        if side is not None
    }


def _samples(
    task: Task, about: Mapping[int, About], chosen: Chosen, records: Mapping[str, CalibrationRecord],
    rejected: Counter[str],
) -> Iterator[TrainingRow | None]:  # fmt: skip
    """The row of each wanted frame in order; None, counted in `rejected`, if it gives no sample."""
    if not about:
        return
    lake, partition, fleet = task.lake, task.partition, task.fleet
    frames = frames_of(lake, partition, sorted(about), chosen)
    rows = observations_of(lake, partition, chosen=chosen)
    whole = (o for o in rows if len(o.sensors) == len(SENSORS) and not o.is_unlabelled)
    observation = next(whole, None)
    if observation is None:
        rejected[SampleReason.SENSOR_MISSING.value] += len(about)
        return
    try:
        prior = read_prior([observation], fleet, partition.vehicle)
    except SolveError:
        prior = None
    if prior is None or not all(prior.knows(pair) for pair in PAIRS):
        rejected[SampleReason.NO_PRIOR.value] += len(about)
        return
    first, reference = _logged_prior(observation), reference_of(records, prior)
    for frame in frames:
        while observation.frame_index < frame.frame_index:
            following = next(whole, None)
            if following is None:
                break
            observation = following
        if observation.frame_index != frame.frame_index:
            rejected[SampleReason.SENSOR_MISSING.value] += 1
            yield None
            continue
        try:
            _require_same(_logged_prior(observation), first)
            yield make_row(frame, observation, reference, about[frame.frame_index], fleet.prepare)
        except SampleRejectedError as rejection:
            rejected[rejection.reason.value] += 1
            yield None


def _require_same(logged: np.ndarray, first: np.ndarray) -> None:
    if not np.allclose(logged, first, atol=_SAME, rtol=0, equal_nan=True):
        raise SampleRejectedError(SampleReason.PRIOR_CHANGED)


def _logged_prior(observation: Observation) -> np.ndarray:
    unknown = np.full((4, 4), np.nan)
    return np.stack([observation.priors.get(pair, unknown) for pair in ("camera_lidar", "lidar_radar")])


def _sides_given(survey: Survey, plan: SplitPlan) -> list[list[str]]:
    """The keys of this day's usable frames and their sides, for later plans."""
    vehicle, day = survey.partition.vehicle, survey.partition.day
    places = {place for place, usable in zip(survey.place, survey.usable, strict=True) if usable}
    keys = {key for place in places for key in Unit(vehicle, day, place).keys(plan.by)}
    return [[kind, value, plan.sides[kind, value]] for kind, value in sorted(keys & plan.sides.keys())]

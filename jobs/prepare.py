"""`boresight prepare`: training data from frames and observations of many vehicle-days."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from jobs.terminal.summary import exit_code, print_summary, problems_of, progress_reporter
from pipeline.core.config import FleetConfig, load_fleet
from pipeline.core.errors import ConfigError
from pipeline.core.results import Outcome
from pipeline.core.runner import try_stage
from pipeline.core.stage_work import Task
from pipeline.core.stages import PREPARE
from pipeline.fleet.executor import EXECUTORS
from pipeline.learn.prepare.inventory import take_inventory, write_inventory
from pipeline.learn.prepare.sides import Choice, decided_sides, price_choices, settled_keys
from pipeline.learn.prepare.split import SplitPlan, Unit
from pipeline.learn.prepare.survey import plan_days, survey_day
from pipeline.store.partitions import Lake, Partition, check_day
from pipeline.store.views import perceived_days
from schemas.training import TRAINING
from schemas.versions import CODE_VERSION

__all__ = ["days_with_observations", "over_days", "prepare"]

_WIDTH = 120  # columns, even without a terminal: one line per choice
_WORDS = {
    "split_conflict": "between the sides",
    "next_to_other_split": "too near in time to another side",
    "hardly_moved": "hardly moved",
    "not_perceived": "not perceived",
    "not_needed": "beyond max_frames",
}


def prepare(
    *,
    fleet: Path,
    lake: str,
    from_day: Annotated[str | None, Parameter(name="--from")] = None,
    to_day: Annotated[str | None, Parameter(name="--to")] = None,
    vehicles: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    executor: Literal["process", "inline"] = "process",
    workers: int | None = None,
) -> int:
    """Make the table training: samples for a network, on sides train, val and test without leaks.

    Prints how many frames the split loses, and how many a split by other keys would lose. Without
    `by` in [prepare.split] it takes the strictest keys that leave no side empty and cost at most a fifth of
    the frames.

    Args:
        fleet: fleet.toml; section [prepare] sets the spacing of frames and the split.
        lake: folder of the tables, with frames and observations.
        from_day: first day, YYYY-MM-DD.
        to_day: last day.
        vehicles: only these vehicles; default: all vehicles of fleet.toml in the lake.
        executor: process (a pool) or inline (one after the other in this process).
        workers: processes at a time; default: one per CPU that this process may use.
    """
    config, tables = load_fleet(fleet), Lake.existing(lake)
    days = days_with_observations(config, tables, from_day, to_day, vehicles)
    for vehicle in {day.vehicle for day in days}:
        config.rig_of(vehicle).one_of_each(f"training on {vehicle}")
    config, planned, choices = _plan(config, tables, days)
    results: list[Outcome] = []
    for end in over_days("prepare", partial(try_stage, PREPARE), planned, executor, workers):
        day = end.item.partition
        results.append(end.value or Outcome("prepare", day.vehicle, day.day, "failed", "", reason=end.error))
    split = config.prepare.split
    with progress_reporter("inventory") as progress:
        progress(0, 0, "compare views")
        inventory = take_inventory(tables, split.duplicate_bits)
    about = {
        "table": TRAINING.name,
        "version": TRAINING.version,
        "code_version": CODE_VERSION,
        "settings": config.prepare.model_dump(mode="json"),
        "choices": [asdict(c) for c in choices],
    }
    path = write_inventory(tables, inventory, about)
    _print_choices(choices, len(inventory.leaks))
    shares = {"train": 1.0, "val": split.val_fraction, "test": split.test_fraction}
    wanted = [side for side, share in shares.items() if share > 0]
    empty = [side for side in wanted if not inventory.frames[side]]
    few = f"no frames: too few to split them by {', '.join(split.by)} (prepare.split.by)"
    code = exit_code([*(r.status for r in results), *("held" for _ in empty)])
    print_summary(
        "prepare",
        {0: "done", 1: "failed", 3: "held"}[code],
        vehicle_days=len(results),
        **{s: sum(r.status == s for r in results) for s in ("done", "cached", "refused", "failed")},
        frames=inventory.frames,
        environments=inventory.environments,
        rejected=inventory.rejected,
        choices=about["choices"],
        leaks=len(inventory.leaks),
        problems=[
            *problems_of(results, "vehicle", "day", "status", "reason"),
            *({"side": side, "status": "held", "reason": few} for side in empty),
        ],
        next_steps=[
            _next_step(fleet, choices, wanted) if empty else f"boresight train --data {lake} --out run"
        ],
        manifest=path,
    )
    return code


def days_with_observations(
    config: FleetConfig,
    lake: Lake,
    from_day: str | None,
    to_day: str | None,
    vehicles: Sequence[str] | None,
) -> list[Partition]:
    """Vehicle-days with observations, for the given days and vehicles; ConfigError if there are none."""
    for name, day in (("--from", from_day), ("--to", to_day)):
        check_day(name, day)
    for vehicle in vehicles or ():
        config.rig_of(vehicle)
    days = [
        p
        for p in perceived_days(lake)
        if (p.vehicle in vehicles if vehicles else config.knows(p.vehicle))
        and (from_day or "") <= p.day <= (to_day or "9999")
    ]
    if not days:
        raise ConfigError(
            "command line", "--lake", f"{lake.root} has no observations of these vehicles and days"
        )
    return days


def _plan(
    config: FleetConfig, lake: Lake, days: Sequence[Partition]
) -> tuple[FleetConfig, list[Task], list[Choice]]:
    """Survey all days and assign sides: configuration with the keys, a task per day, and other splits."""
    surveys = []
    with progress_reporter("survey") as progress:
        for done, day in enumerate(days):
            progress(done, len(days), f"{day.vehicle} {day.day}")
            surveys.append(survey_day(day, lake, config.prepare))
    split = config.prepare.split_with(by=settled_keys(surveys, config.prepare, lake))
    config = config.model_copy(update={"prepare": split})
    plan = plan_days(surveys, config.prepare, decided_sides(lake, config.prepare))
    work = []
    for survey in surveys:
        day = survey.partition
        reached = (survey.reached(frame, config.prepare) for frame in range(len(survey.place)))
        keys = {
            k
            for place in set(survey.place).union(*reached)
            for k in Unit(day.vehicle, day.day, place).keys(plan.by)
        }
        own = SplitPlan(plan.by, {k: plan.sides[k] for k in keys & plan.sides.keys()})
        work.append(Task(config, lake, day, given=own))
    return config, work, price_choices(surveys, plan, config.prepare)


def over_days(
    title: str, run: Callable[..., Any], tasks: Sequence[Any], executor: str, workers: int | None
) -> Iterator[Any]:
    """Ends of the work on vehicle-days, with progress; each task has a `partition`."""
    if workers is not None and workers < 1:
        raise ConfigError("command line", "--workers", f"{workers} is less than one")
    ended = 0
    with progress_reporter(title) as progress:

        def watch(index: int, done: int, total: int, what: str) -> None:
            day = tasks[index].partition
            progress(ended, len(tasks), f"{day.vehicle} {day.day}: {what} {done}/{total}")

        with closing(EXECUTORS[executor](run, tasks, workers, watch)) as finished:
            for end in finished:
                ended += 1
                yield end


def _next_step(fleet: Path, choices: Sequence[Choice], wanted: Sequence[str]) -> str:
    """What to do where a side is empty: the first other split that has all wanted sides, if there is one."""
    for choice in choices:
        if all(choice.frames[side] for side in wanted):
            by = ", ".join(f'"{name}"' for name in choice.split_by)
            frames = ", ".join(f"{choice.frames[side]} {side}" for side in wanted)
            return f"set by = [{by}] under [prepare.split] in {fleet}: {frames} frames; then prepare again"
    without = "val_fraction and test_fraction to 0 under [prepare.split]"
    return f"set {without} in {fleet}, or add days; then prepare again"


def _print_choices(choices: Sequence[Choice], leaks: int) -> None:
    """Print the splits as a table on stderr, the chosen split first, and the number of frames that leak."""
    table = Table(box=None, title="frames kept and lost by split", title_justify="left")
    for name in ("by", "train", "val", "test", "lost", "of them", "days without"):
        table.add_column(name, justify="left" if name in ("by", "of them") else "right")
    for choice in choices:
        table.add_row(
            " ".join(choice.split_by) + (" (taken)" if choice.chosen else ""),
            *(str(count) for count in choice.frames.values()),
            str(sum(choice.lost.values())),
            ", ".join(f"{count} {_WORDS.get(reason, reason)}" for reason, count in choice.lost.items()),
            str(choice.empty_vehicle_days),
        )
    console = Console(stderr=True, width=_WIDTH)
    console.print(table)
    if leaks:
        console.print(
            f"leaks: {leaks} frames of val and test look like one of train; training leaves them out"
        )

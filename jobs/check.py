"""`boresight check`: whether logs can be calibrated, and in which DoF."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jobs.terminal.summary import print_json, print_summary, progress_reporter
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.ingest.check import CheckReport, check_logs
from pipeline.ingest.propose.survey import nightly_command
from pipeline.ingest.readiness import overall
from pipeline.ingest.rig_sample import PairFinding, RigFinding, dof_counts
from pipeline.perceive.models.source import check_models
from pipeline.rig.day_prior import require_named_files

__all__ = ["check", "print_rig"]

_EXIT = {"yes": 0, "weak": 1, "partly": 1, "no": 2}
_COLOUR = {"yes": "green", "weak": "yellow", "partly": "yellow", "no": "red"}


def check(fleet: Path, /, *logs: Path, rig: str | None = None, json: bool = False) -> int:
    """Check whether logs can be calibrated, in which DoF, and what is missing. Exit 0 yes, 1 weakly or partly, 2 no.

    Args:
        fleet: fleet.toml.
        logs: MCAP files, ROS 1 bags, ROS 2 bag folders or .db3 files of one vehicle-day.
        rig: rig of fleet.toml; default: the only one, or "default".
        json: print the whole report as one JSON object on stdout.
    """
    config = load_fleet(fleet)
    require_named_files(config)
    name = rig or (next(iter(config.rigs)) if len(config.rigs) == 1 else "default")
    if name not in config.rigs:
        raise ConfigError(
            str(fleet), "rigs", f"no rig {name!r}; name one of {sorted(config.rigs)} with --rig"
        )
    check_models(config.rigs[name], config)
    if not logs:
        raise ConfigError("command line", "LOG", "name at least one log")
    with progress_reporter("check") as progress:
        report = check_logs(logs, config.rigs[name], config, progress)
    if json:
        print_json(asdict(report))
    else:
        _print_report(report, name)
        following = _following(report, fleet, logs)
        print_summary(
            "check",
            report.answer,
            rig=name,
            frames=report.evidence.frames,
            pairs=_of_pairs(report),
            problems=report.problems,
            next_steps=following,
        )
    return _EXIT[report.answer]


def _following(report: CheckReport, fleet: Path, logs: tuple[Path, ...]) -> list[str]:
    """Next steps: what to correct, and then this check again; else labels for cameras, and the night."""
    if report.corrections:
        again = f"boresight check {fleet} {' '.join(map(str, logs))}"
        return [*report.corrections, again]
    unlabelled = any("boresight models --fetch" in why for v in report.verdicts for why in v.reasons)
    fetch = ["boresight models --fetch"] if unlabelled else []
    return fetch if report.answer == "no" else [*fetch, *nightly_command(fleet, logs)]


def _of_pairs(report: CheckReport) -> dict[str, str]:
    """The answer of each pair."""
    pairs = dict.fromkeys(v.pair for v in report.verdicts)
    return {pair: overall([v for v in report.verdicts if v.pair == pair]) for pair in pairs}


def _print_report(report: CheckReport, rig: str) -> None:
    console = Console(stderr=True)
    topics = Table(title=f"Topics of rig {rig}", title_justify="left")
    for heading in ("role", "topic", "type", "messages", "rate", ""):
        is_number = heading in {"messages", "rate"}
        topics.add_column(heading, justify="right" if is_number else "left", overflow="fold")
    for t in report.topics:
        rate = "" if t.rate_hz is None else f"{t.rate_hz:.2f} Hz"
        mark = f"[red]{t.problem}[/]" if t.problem else "[green]ok[/]"
        kinds = ", ".join(kind.rsplit("/", 1)[-1] for kind in t.types)
        topics.add_row(t.role, t.topic, kinds, str(t.messages), rate, mark)
    console.print(topics)
    for line in _measured(report):
        console.print(line, markup=False, highlight=False)
    print_rig(console, report.rig)
    for line in [*report.problems, *report.advice]:
        console.print(f"  - {line}", markup=False)
    answer = report.answer
    if answer == "weak":
        weak = " and ".join(pair for pair, own in _of_pairs(report).items() if own == "weak")
        answer = f"yes, but {weak} may be held: each of its axes depends on the prior"
    console.print(f"Can these logs be calibrated: [{_COLOUR[report.answer]} bold]{escape(answer)}[/]")


def _measured(report: CheckReport) -> list[str]:
    e, s = report.evidence, report.sync
    frame_ids = [f"{sensor} {' '.join(names)}" for sensor, names in report.frame_ids.items()]
    facts = {
        "prior": "yes" if e.has_prior else "none",
        "moving": "unknown" if e.moving_share is None else f"{e.moving_share:.0%} of the frames",
        "radar elevation": "yes" if e.elevation_share > 0.5 else "no",
        "lidar rings": e.rings or "unknown",
        "lidar intensity": "yes" if e.has_intensity else "no",
        "time per point": "yes" if report.has_point_time else "no",
        "odometry": "yes" if report.has_odometry else "no",
    }
    gate = "within the motion limit" if s.gate_ms is None else f"within {s.gate_ms:g} ms"
    found = {
        "image": ("camera", s.camera_median_ms, s.camera_offset_ms),
        "scan": ("radar", s.radar_median_ms, s.radar_offset_ms),
    }
    met = {name: of for name, of in found.items() if of[1] is not None}
    offsets = ", ".join(f"{sensor} {offset:+.1f} ms" for sensor, _, offset in met.values())
    nearest = ", ".join(f"to {name} {median:.2f} ms" for name, (_, median, _) in met.items())
    sync = f"{s.moments} of {s.sweeps} sweeps have {' and '.join(met) or 'no partner'} {gate}"
    known = "; ".join(f"{name}: {value}" for name, value in facts.items())
    return [
        f"sync: {sync}" + (f" (median {nearest}; constant offsets: {offsets})" if met else ""),
        f"frame ids: {', '.join(frame_ids) or 'none'}",
        known if e.frames else f"unknown, because no frame is given: {', '.join(facts)}",
    ]


_NAMED = 4  # edges named per line; the others are counted


def print_rig(console: Console, rig: RigFinding) -> None:
    """Print the matrix: a row for each sensor, a column for each sensor with which it could have an edge."""
    pairs = {(p.parent, p.child): p for p in rig.pairs}
    columns = [s for s in rig.sensors if any(child == s for _, child in pairs)]
    rows = [s for s in rig.sensors if any(parent == s for parent, _ in pairs)]
    table = Table(title="Shared views", title_justify="left", padding=(0, 1, 0, 0), pad_edge=False)
    for column in ("", *columns):
        table.add_column(column, justify="right" if column else "left")
    for row in rows:
        name = f"{row} *" if row == rig.reference else row
        table.add_row(name, *(_cell(pairs.get((row, column))) for column in columns))
    console.print(table)
    console.print(
        "first line: overlap as a share of the smaller view, and moments with both sensors; "
        "second line: determined + partly determined degrees of freedom, of 6"
    )
    console.print(f"poses refer to {rig.reference} (*); pairs without a second line are not calibrated")
    for (verdict, reason, edges), dofs in _reasons(rig).items():
        more = f" and {len(edges) - _NAMED} more" if len(edges) > _NAMED else ""
        of = f"{'; '.join(dofs)} of {', '.join(edges[:_NAMED])}{more}"
        console.print(f"  - [{_COLOUR[verdict]}]{verdict}[/]: {of}: {escape(reason)}")
    if rig.loose:
        console.print(f"  - no edge joins {', '.join(rig.loose)} to {rig.reference}", markup=False)


def _cell(pair: PairFinding | None) -> str:
    if pair is None:
        return ""
    share = "" if pair.share is None else f"{pair.share:.0%} "
    if not pair.is_edge:
        return f"[bright_black]{share or '- '}{pair.moments}[/]"
    given, weak = dof_counts(pair.verdicts)
    colour = "green" if given else "yellow" if weak else "red"
    return f"{share}{pair.moments}\n[{colour}]{given}+{weak}[/]"


def _reasons(rig: RigFinding) -> dict[tuple[str, str, tuple[str, ...]], list[str]]:
    """Missing requirements of edges: DoF classes, grouped by verdict, reason and set of edges."""
    edges: dict[tuple[str, str, str], list[str]] = {}
    for verdict in (v for pair in rig.pairs for v in pair.verdicts):
        for reason in verdict.reasons:
            edges.setdefault((verdict.dof, verdict.verdict, reason), []).append(verdict.pair)
    found: dict[tuple[str, str, tuple[str, ...]], list[str]] = {}
    for (dof, word, reason), pairs in edges.items():
        found.setdefault((word, reason, tuple(pairs)), []).append(dof)
    return found

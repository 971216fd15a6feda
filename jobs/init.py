"""`boresight init`: write a fleet.toml from logs."""

from __future__ import annotations

from pathlib import Path

from jobs.terminal.summary import print_summary, progress_reporter
from pipeline.core.errors import ConfigError
from pipeline.ingest.propose.propose import propose_fleet
from pipeline.ingest.propose.survey import nightly_command
from pipeline.store.atomic_write import atomic_write

__all__ = ["init"]


def init(*logs: Path, out: Path = Path("fleet.toml"), name: str = "fleet", force: bool = False) -> int:
    """Write a fleet.toml for logs: sensors, topics, meaning of radar fields; comments name missing entries.

    Args:
        logs: some MCAP files, ROS 1 bags, ROS 2 bag folders or .db3 files of vehicles with the same sensors.
        out: file to write.
        name: name of the fleet.
        force: replace the file if it exists.
    """
    if not logs:
        raise ConfigError("command line", "LOG", "name at least one log")
    missing = [str(p) for p in logs if not p.exists()]
    if missing:
        raise ConfigError("command line", "LOG", f"no such file: {', '.join(missing)}")
    if out.exists() and not force:
        raise ConfigError(str(out), "--out", "exists already; --force replaces it")
    with progress_reporter("init") as progress:
        proposal = propose_fleet(logs, name, progress)
    with atomic_write(out) as file:
        file.write(proposal.text.encode())
    some = " ".join(str(p) for p in proposal.logs[:8])
    unlabelled = any(": semantics" in what for what in proposal.missing)
    fetch = ["boresight models --fetch"] if unlabelled else []
    print_summary(
        "init",
        "done",
        written=str(out),
        sensors=list(proposal.sensors),
        to_enter=list(proposal.missing),
        problems=list(proposal.problems),
        next_steps=[*fetch, f"boresight check {out} {some}", *nightly_command(out, proposal.logs)],
    )
    return 0

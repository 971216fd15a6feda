"""Which test seeds were looked at, when and by which code: results/seeds.toml, one entry per look.

A number on test seeds is honest once: whoever sees it may change the code because of it. So a table is a first look
only where the code that made it is the code that looked at its seeds first; all that comes later is a second look, and
says so. Tuning seeds are for looking.
"""

from __future__ import annotations

import time
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["freshness", "look", "read_looks"]

RECORD = Path(__file__).parents[1] / "results" / "seeds.toml"
# 0: the real day. Below 200: the days of days.py for tuning. From 1000: the fleet that networks learnt from.
_TUNING = frozenset([*range(200), *range(1000, 1100)])


@dataclass(frozen=True)
class Look:
    """Somebody saw what this code makes of these days."""

    study: str
    seeds: frozenset[int]
    commit: str


def read_looks(record: Path = RECORD) -> list[Look]:
    """All looks, the oldest first; none where there is no file."""
    if not record.exists():
        return []
    entries = tomllib.loads(record.read_text()).get("look", [])
    return [Look(e["study"], _seeds_of(e["seeds"]), e["commit"]) for e in entries]


def look(study: str, results: Sequence[dict[str, Any]], record: Path = RECORD) -> str:
    """Note down that the seeds of these result lines are seen now; returns whether this is a first look at them."""
    known = read_looks(record)
    found: dict[str, set[int]] = {}
    for commit in dict.fromkeys(r["commit"] for r in results):
        seeds = {r["day"]["seed"] for r in results if r["commit"] == commit}
        for seed in seeds:
            found.setdefault(freshness(seed, commit, known), set()).add(seed)
        seen = [e.seeds for e in known if e.commit == commit and e.study == study]
        if new := seeds.difference(_TUNING, *seen):
            with record.open("a") as file:
                file.write(
                    f'\n[[look]]\nstudy = "{study}"\nseeds = "{_ranges(new)}"\ncommit = "{commit}"\n'
                    f'date = "{time.strftime("%Y-%m-%d")}"\n'
                )
    return "; ".join(f"{what}: days of seeds {_ranges(seeds)}" for what, seeds in found.items())


def freshness(seed: int, commit: str, known: Sequence[Look]) -> str:
    """In a word, "tuned on", "first" or "second": the latter two by commits' names alone, whatever git has of them."""
    if seed in _TUNING:
        return "tuned on"
    first = next((e for e in known if seed in e.seeds), None)
    return "first" if first is None or first.commit == commit else "second"


def _seeds_of(text: str) -> frozenset[int]:
    """Seeds of "200-209, 300": both ends belong to a range."""
    ends = [[int(v) for v in part.split("-")] for part in text.split(",")]
    return frozenset(seed for e in ends for seed in range(e[0], e[-1] + 1))


def _ranges(seeds: Iterable[int]) -> str:
    """Shortest text that `_seeds_of` reads back."""
    runs: list[list[int]] = []
    for seed in sorted(seeds):
        if runs and seed == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], seed]
        else:
            runs.append([seed])
    return ", ".join("-".join(map(str, run)) for run in runs)

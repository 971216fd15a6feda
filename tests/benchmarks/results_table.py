"""The result tables of both READMEs, made of results/rows.toml and of the files that it names.

    python -m tests.benchmarks.results_table          writes them (make results)

A row names a question, its file, how the number is computed (`results_measures.py`), and with `top` the best number
that others publish. A row whose file is not there is left out. What else a reader
must know to believe the number is computed: the release of the code (results/releases.toml, kept because commits are
rebased), whether its seeds were looked at before (results/seeds.toml), on how many distinct days it rests, and for a
rate its 95 % interval.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.benchmarks.results_measures import MEASURES
from tests.benchmarks.studies.looks import freshness, read_looks

__all__ = ["TARGETS", "WIDEST", "release_now", "release_of", "written"]

RESULTS = Path(__file__).parent / "results"
REPO = Path(__file__).resolve().parents[2]
ROWS = RESULTS / "rows.toml"
RELEASES = RESULTS / "releases.toml"
BEGIN, END = "<!-- results: written by make results -->", "<!-- end of results -->"
TARGETS = {REPO / "README.md": True, RESULTS / "README.md": False}  # the first has rows of `top` alone
WIDEST = 110  # characters of a line of the first


def rows(path: Path = ROWS) -> list[dict[str, Any]]:
    """All rows, in order."""
    return list(tomllib.loads(path.read_text())["row"])


def lines_of(row: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Lines of the row's file that its `where` chooses."""
    if "file" not in row:
        return []
    found = [json.loads(line) for line in (RESULTS / row["file"]).read_text().splitlines()]
    chosen = [r for r in found if all(_at(r, key) in _listed(v) for key, v in row.get("where", {}).items())]
    if not chosen:
        raise SystemExit(f"rows.toml: no line of {row['file']} is chosen for {row['question']!r}")
    return chosen


def render(top_only: bool) -> str:
    """The table as Markdown."""
    heads = [
        "question", "measured (95 % interval)", "days, look", "best published" if top_only else "release",
    ]  # fmt: skip
    chosen = [row for row in rows() if row.get("top") or not top_only]
    body = [_cells(row, top_only) for row in chosen if "file" not in row or (RESULTS / row["file"]).exists()]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [heads, ["---"] * len(heads), *body])


def _cells(row: Mapping[str, Any], top_only: bool) -> list[str]:
    lines = lines_of(row)
    text = row["measured"] if "measured" in row else MEASURES[row["measure"]](lines, row)
    days, release = f"{_days(lines, row)}, {_look(lines, row)}", _release(lines, row)
    if top_only:  # a release is named where it is another than this one
        return [row["question"], text, f"{days}, {release}" if "older" in release else days, row["published"]]
    return [row["question"], text, days, release]


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _at(line: Mapping[str, Any], key: str) -> Any:
    """Value at "day.rig"; None where there is none."""
    value: Any = line
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _days(lines: Sequence[Mapping[str, Any]], row: Mapping[str, Any]) -> str:
    """Distinct vehicle-days: one that is calibrated twice, or with another fault put into its rows, counts once."""
    if "days" in row:
        return str(row["days"])
    which = ("rig", "environment", "seed", "vehicle", "night")
    return str(len({tuple(d.get(name) for name in which) for d in (r.get("day", r) for r in lines)}))


def _look(lines: Sequence[Mapping[str, Any]], row: Mapping[str, Any]) -> str:
    """First or second look, by the seeds that were noted; a row of other lines says it itself."""
    if "look" in row:
        return str(row["look"])
    known = read_looks()
    said = {freshness(int(r.get("day", r)["seed"]), str(r["commit"]), known) for r in lines}
    return "tuned on" if "tuned on" in said else "second" if "second" in said else "first"


def _release(lines: Sequence[Mapping[str, Any]], row: Mapping[str, Any]) -> str:
    """Releases whose code was measured, the oldest first, and whether the code has gone on since."""
    found = sorted({release_of(commit) for commit in _commits(lines, row)}, key=_order)
    return " to ".join(dict.fromkeys((found[0], found[-1]))) + (
        "" if found[0] == release_now() else ", older"
    )


def release_now() -> str:
    """The release that the code is on its way to: the topmost of the changelog."""
    found = re.search(r"^## (\d+\.\d+\.\d+)", (REPO / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert found is not None, "a changelog without a release"
    return found[1]


def release_of(commit: str) -> str:
    """The release that a commit was on its way to, as releases.toml has it."""
    known = tomllib.loads(RELEASES.read_text())["releases"]
    if commit not in known:
        raise SystemExit(f"{RELEASES}: name the release that commit {commit} was on its way to")
    return str(known[commit])


def _commits(lines: Sequence[Mapping[str, Any]], row: Mapping[str, Any]) -> set[str]:
    """Commits of lines, less the + of a working tree with changes; of a row whose lines have none, its own."""
    return {str(c).removesuffix("+") for r in lines if (c := r.get("commit"))} or {str(row["commit"])}


def _order(release: str) -> tuple[int, ...]:
    return tuple(int(part) for part in release.split("."))


def written(path: Path, top_only: bool) -> str:
    """The file with its table made anew."""
    before, found, rest = path.read_text().partition(BEGIN)
    after = rest.partition(END)[2]
    if not found:
        raise SystemExit(f"{path} has no line {BEGIN}")
    return f"{before}{BEGIN}\n{render(top_only)}\n{END}{after}"


def main() -> None:
    """Write both tables."""
    for path, top_only in TARGETS.items():
        path.write_text(written(path, top_only))


if __name__ == "__main__":
    main()

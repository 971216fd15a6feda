"""A rig as a printed matrix of its edges, followed by the data that edges lack."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from pipeline.ingest.rig_matrix import PairFinding, RigFinding

__all__ = ["print_rig"]

_NAMED = 4  # edges named per line; the others are counted
_COLOUR = {"yes": "green", "weak": "yellow", "no": "red"}


def print_rig(console: Console, rig: RigFinding) -> None:
    """Print the matrix: a row for each sensor, a column for each sensor with which it could have an edge."""
    from rich.markup import escape
    from rich.table import Table

    pairs = {(p.parent, p.child): p for p in rig.pairs}
    columns = [s for s in rig.sensors if any(child == s for _, child in pairs)]
    rows = [s for s in rig.sensors if any(parent == s for parent, _ in pairs)]
    table = Table(title="Shared views", title_justify="left", padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("")
    for column in columns:
        table.add_column(column, justify="right")
    for row in rows:
        name = f"{row} *" if row == rig.reference else row
        table.add_row(name, *(_cell(pairs.get((row, column))) for column in columns))
    console.print(table)
    console.print(
        "first line: overlap as share of the smaller view (before perception), moments with both sensors; "
        "second line: of 6 degrees of freedom, determined + determined in part"
    )
    console.print(f"poses refer to {rig.reference} (*); pairs without a second line are not calibrated")
    for (verdict, reason, edges), dofs in _reasons(rig).items():
        named = ", ".join(edges[:_NAMED]) + (
            f" and {len(edges) - _NAMED} more" if len(edges) > _NAMED else ""
        )
        console.print(f"  - [{_COLOUR[verdict]}]{verdict}[/]: {'; '.join(dofs)} of {named}: {escape(reason)}")
    if rig.loose:
        console.print(f"  - no edge joins {', '.join(rig.loose)} to {rig.reference}", markup=False)


def _cell(pair: PairFinding | None) -> str:
    from pipeline.ingest.rig_matrix import dof_counts

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

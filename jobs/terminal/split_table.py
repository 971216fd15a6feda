"""A split as a printed table: frames of each side and frames lost, compared with other splits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.learn.prepare.sides import Choice

__all__ = ["print_choices"]

_WIDTH = 120  # columns, even without a terminal: one line per choice

_WORDS = {
    "split_conflict": "between the sides",
    "next_to_other_split": "too near in time to another side",
    "hardly_moved": "hardly moved",
    "not_perceived": "not perceived",
    "not_needed": "beyond max_frames",
}


def print_choices(choices: Sequence[Choice]) -> None:
    """Print the splits as a table on stderr, the chosen split first."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, title="frames kept and lost by split", title_justify="left")
    for name in ("split_by", "train", "val", "test", "lost", "of them", "days without"):
        table.add_column(name, justify="left" if name in ("split_by", "of them") else "right")
    for choice in choices:
        table.add_row(
            " ".join(choice.split_by) + (" (made)" if choice.chosen else ""),
            *(str(count) for count in choice.frames.values()),
            str(sum(choice.lost.values())),
            ", ".join(f"{count} {_WORDS.get(reason, reason)}" for reason, count in choice.lost.items()),
            str(choice.empty_vehicle_days),
        )
    Console(stderr=True, width=_WIDTH).print(table)

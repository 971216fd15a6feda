"""`boresight models`: the networks that ship, what they are for, and whether the files are the right ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.shipped_models import ShippedModel

__all__ = ["models"]

_WIDTH = 120  # columns, also where nobody watches: a sha256 and a path fit


def models(*, json: bool = False) -> int:
    """List every model that ships with the package, and compare each file with the sha256 of its card.

    Exit code 1 where a file is not the one that its card speaks of, or a card lacks something.

    Args:
        json: the summary's "models" holds the whole cards.
    """
    from jobs.terminal.summary import print_summary
    from pipeline.shipped_models import shipped_models

    found = shipped_models()
    if not json:
        _print_table(found)
    wrong = [model for model in found if model.problems]
    print_summary(
        "models",
        "failed" if wrong else "done",
        models=[
            {"name": model.name, "path": model.file, "problems": model.problems}
            | (model.card if json else {})
            for model in found
        ],
    )
    return 1 if wrong else 0


def _print_table(found: Sequence[ShippedModel]) -> None:
    """One block per model, for people, on stderr."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(stderr=True, width=_WIDTH, highlight=False)
    for model in found:
        card = model.card
        table = Table(box=None, show_header=False, title=model.name, title_justify="left", title_style="bold")
        size = f"{card.get('bytes', 0) / 1e6:.1f} MB, {card.get('parameters', 0):,} parameters"
        rows = {
            "for": card.get("purpose", ""), "licence": card.get("license", ""), "size": size,
            "sha256": card.get("sha256", ""), "made by": card.get("command", ""),
            "card": str(model.file.with_suffix(".md")), "file": "; ".join(model.problems) or "as its card says",
        }  # fmt: skip
        for name, value in rows.items():
            table.add_row(f"  {name}", escape(str(value)))  # a card may say `[learn]`, which is no style
        console.print(table)

"""Two calibrations side by side: a line per pair and axis, in degrees and metres."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.rig.differences import PairDifference

__all__ = ["print_comparison"]

_CLEAR_SIGMAS = 3.0  # as everywhere: chance alone exceeds it once in 370 times


def print_comparison(titles: Sequence[str], found: Sequence[PairDifference], notes: Sequence[str]) -> None:
    """Print the change from the first to the second; changes that sigmas do not explain are bold."""
    import numpy as np
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from pipeline.report.words import dof_title, scaled, unit_of
    from schemas.calibrations import DOF_NAMES

    view = Table(title=f"from {titles[0]} to {titles[1]}", title_justify="left")
    for name in ("pair", "axis", "change", "sigma", "z", ""):
        view.add_column(name, justify="right" if name in ("change", "sigma", "z") else "left", no_wrap=True)
    for pair in found:
        for k, dof in enumerate(DOF_NAMES):
            z = None if pair.z is None else float(pair.z[k])
            cells = [
                pair.pair if k == 0 else "",
                dof_title(pair.edge.kind, dof),
                f"{scaled(pair.change[k], dof):+.4f} {unit_of(dof)}",
                "" if pair.sigma is None else f"{scaled(pair.sigma[k], dof):.4f}",
                "" if z is None else f"{z:+.1f}",
                "" if pair.determined[k] else "at the prior",
            ]
            clear = z is not None and abs(z) > _CLEAR_SIGMAS
            view.add_row(*(Text(c, "bold" if clear else "") for c in cells))
        azimuth, elevation = np.degrees(pair.targets_rad)
        moved = f"targets at 15 to 40 m move {azimuth:.3f} deg in azimuth, {elevation:.3f} deg in elevation"
        words = "" if set(pair.statuses) == {"accepted"} else f" ({' and '.join(pair.statuses)})"
        notes = [*notes, f"{pair.pair}: {moved}{words}"]
    console = Console(width=None if sys.stdout.isatty() else 120)
    console.print(view)
    for note in notes:
        console.print(Text(note), soft_wrap=True)

"""`boresight compare`: the difference between two calibrations, and whether their sigmas explain it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from jobs.calibration_sources import FrameOptions, read_sides
from jobs.terminal.summary import print_json, print_summary
from pipeline.core.errors import ConfigError
from pipeline.export.compare import compare as compare_sides
from pipeline.report.comparison import comparison_page
from pipeline.report.page import write_page
from pipeline.report.words import dof_title, scaled, unit_of
from pipeline.rig.targets import PairDifference
from schemas.calibrations import DOF_NAMES

__all__ = ["compare"]

_CLEAR_SIGMAS = 3.0  # as everywhere: chance alone exceeds it once in 370 times


def compare(
    a: str,
    b: str,
    /,
    *,
    lake: str | None = None,
    vehicle: str | None = None,
    method: str = "joint",
    page: Path | None = None,
    json: bool = False,
    frames: FrameOptions | None = None,
) -> int:
    """Compare two calibrations: the change from A to B per pair and axis, with sigma, and in units of sigma.

    A and B are each one of: log:FILE (what the car runs: its /tf_static); FORMAT:FILE[,FILE] (formats of `boresight
    export`); a prior file, *.json; or, from a lake, [VEHICLE@]DAY[/METHOD], as in 2026-03-02, 2026-03-02/joint-ssl,
    2026-03-02/prior (the prior of that day), state (to load tonight), car-2@state. Held records are marked.

    Args:
        a: first calibration.
        b: second calibration.
        lake: folder of the tables.
        vehicle: vehicle id, if A or B does not name it.
        method: calibration method, if A or B does not name it.
        page: HTML page to write as well.
        json: print only one JSON object: changes and sigmas in rad and m.
        frames: frame names in files.
    """
    names = frames or FrameOptions()
    sides = read_sides([a, b], lake, vehicle, method, names)
    found, notes = compare_sides(*sides)
    titles = [side.title for side in sides]
    if not found:
        raise ConfigError("command line", "A, B", f"no pair in common; {'; '.join(notes)}".rstrip("; "))
    if page is not None:
        write_page(page, comparison_page(titles[0], titles[1], found, notes))
    pairs = [_plain(p) for p in found]
    if json:
        print_json({"a": titles[0], "b": titles[1], "notes": notes, "pairs": pairs}, indent=2)
        return 0

    _print_comparison(titles, found, notes)
    largest = max((row["z"] for p in pairs for row in p["axes"] if row["z"]), key=abs, default=None)
    print_summary("compare", "done", a=titles[0], b=titles[1], largest_z=largest, page=page)
    return 0


def _plain(difference: PairDifference) -> dict[str, Any]:
    sigma, z = difference.sigma, difference.z
    axes = [
        {
            "dof": dof,
            "unit": "rad" if k < 3 else "m",
            "change": difference.change[k],
            "sigma": None if sigma is None else sigma[k],
            "z": None if z is None else float(z[k]),
            "determined": bool(difference.determined[k]),
        }
        for k, dof in enumerate(DOF_NAMES)
    ]
    return {
        "pair": difference.pair,
        "parent_frame": difference.edge.parent.name,
        "child_frame": difference.edge.child.name,
        "status_a": difference.statuses[0],
        "status_b": difference.statuses[1],
        "target_azimuth_rad": difference.targets_rad[0],
        "target_elevation_rad": difference.targets_rad[1],
        "axes": axes,
    }


def _print_comparison(titles: Sequence[str], found: Sequence[PairDifference], notes: Sequence[str]) -> None:
    """Print the change from the first to the second; changes that sigmas do not explain are bold."""
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

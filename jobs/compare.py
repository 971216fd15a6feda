"""`boresight compare`: the difference between two calibrations, and whether their sigmas explain it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from jobs.frame_options import FrameOptions

if TYPE_CHECKING:
    from pipeline.rig.differences import PairDifference

__all__ = ["compare"]


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

    A and B are each one of: FORMAT:FILE[,FILE] (formats of `boresight export`); a prior file, *.json; or,
    from a lake, [VEHICLE@]DAY[/METHOD], as in 2026-03-02, 2026-03-02/joint-ssl, 2026-03-02/prior (the prior
    of that day), state (to load tonight), car-2@state. Held records are compared too, and marked.

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
    from jobs.calibration_sources import read_sides
    from jobs.terminal.summary import print_json, print_summary
    from pipeline.core.errors import ConfigError
    from pipeline.export.compare import compare as compare_sides

    names = frames or FrameOptions()
    sides = read_sides([a, b], lake, vehicle, method, names)
    found, notes = compare_sides(*sides)
    titles = [side.title for side in sides]
    if not found:
        raise ConfigError("command line", "A, B", f"no pair in common; {'; '.join(notes)}".rstrip("; "))
    if page is not None:
        _write_page(page, titles, found, notes)
    plain: dict[str, Any] = {
        "a": titles[0],
        "b": titles[1],
        "notes": notes,
        "pairs": [_plain(p) for p in found],
    }
    if json:
        print_json(plain, indent=2)
        return 0
    from jobs.terminal.comparison_table import print_comparison

    print_comparison(titles, found, notes)
    largest = max((row["z"] for p in plain["pairs"] for row in p["axes"] if row["z"]), key=abs, default=None)
    print_summary("compare", "done", a=titles[0], b=titles[1], largest_z=largest, page=page)
    return 0


def _plain(difference: PairDifference) -> dict[str, Any]:
    from schemas.calibrations import DOF_NAMES

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


def _write_page(page: Path, titles: list[str], found: list[PairDifference], notes: list[str]) -> None:
    from pipeline.report.comparison import comparison_page
    from pipeline.report.page import write_page

    write_page(page, comparison_page(titles[0], titles[1], found, notes))

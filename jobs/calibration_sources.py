"""Calibrations that commands name: of a lake's day or state, and where a lidar sits, of a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np

    from pipeline.export.calibration import ExportedCalibration, FrameNames

__all__ = ["mounting", "read_calibration"]


def read_calibration(
    location: str,
    vehicle: str,
    day: str | None,
    method: str,
    *,
    force: bool,
    names: FrameNames,
    T_base_lidar: np.ndarray | None,
) -> ExportedCalibration:
    """A day's records, or without a day the vehicle's state, ready for a file.

    Raises:
        ConfigError: there is none.
    """
    from jobs.terminal.summary import left_out as tell_damage
    from pipeline.export.calibration import ExportedCalibration
    from pipeline.export.lake import choose_pairs, pairs_of_day, pairs_of_state, read_camera
    from pipeline.store.partitions import Lake
    from schemas.versions import CODE_VERSION

    lake = Lake.existing(location)
    if day is None:
        found, source = pairs_of_state(lake, vehicle, method), "state"
    else:
        found, source = pairs_of_day(lake, vehicle, day, method), f"record of {day}"
    pairs, without = choose_pairs(found, force=force)
    details = [p.details for p in pairs.values()]
    days = {str(d) for detail in details for d in _listed(detail.get("days"))} | ({day} if day else set())
    camera = read_camera(lake, vehicle, days)
    if day is None:
        source = f"state of {max((str(d['day']) for d in details), default='no day')}"
    tell_damage(lake)
    return ExportedCalibration(
        vehicle, source, method, CODE_VERSION, pairs, camera, names, T_base_lidar, without
    )


def _listed(value: object) -> list[object]:
    return list(value) if isinstance(value, list) else []


def mounting(text: str, names: FrameNames) -> np.ndarray:
    """T_base_lidar out of FORMAT:FILE.

    Raises:
        ConfigError: not of that form, or the file does not join the two frames.
    """
    from pipeline.export.files import read_files
    from pipeline.export.formats import format_named

    name, colon, path = text.partition(":")
    if not colon:
        raise ConfigError("command line", "mount", f"{text!r} is not FORMAT:FILE, as tf-static:log.mcap")
    form = format_named(name)
    if form.tree is None:
        raise ConfigError("command line", "mount", f"{name} knows no frames of a car")
    tree = form.tree(read_files([Path(path)]))
    T = tree.lookup(names.base, names.lidar)
    if T is None:
        frames = ", ".join(sorted({*tree.edges, *tree.edges.values()}))
        problem = f"no chain joins these frames; the file has: {frames or 'none'}"
        raise ConfigError(path, f"{names.base}, {names.lidar}", problem)
    return T

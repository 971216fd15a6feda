"""`boresight import`: calibration files of other programs to a prior file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from jobs.calibration_sources import FrameOptions
from jobs.terminal.summary import print_summary
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.export.files import (
    noted_frames,
    prior_text,
    read_files,
    reference_of_rig,
    rig_poses,
    star_text,
    write_files,
)
from pipeline.export.formats import format_named
from pipeline.export.tree import ESTIMATED_PAIRS
from pipeline.rig.day_prior import read_star, read_transforms
from pipeline.rig.prior import between
from pipeline.rig.rig import Rig

__all__ = ["import_prior"]


def import_prior(
    form: str,
    files: list[Path],
    /,
    *,
    out: Path,
    also: Path | None = None,
    fleet: Path | None = None,
    rig: str | None = None,
    frames: FrameOptions | None = None,
) -> int:
    """Convert calibration files of another program to a prior file, for three sensors or for a whole rig.

    Args:
        form: a format of `boresight export`, or vod: View-of-Delft, the lidar's file and the radar's.
        files: all files of the calibration.
        out: prior file to write; use it in fleet.toml: [rigs.*.prior] source = "file", file = "...".
        also: prior file for sensors that the files lack, as radars in files of cameras.
        fleet: fleet.toml with the rig whose sensors are read, by sensor name or by the name in --frame.
        rig: rig of fleet.toml; default: the only one.
        frames: frame names in the files.
    """
    read, options = read_files(files), frames or FrameOptions()
    if fleet is not None:
        content, taken = _of_rig(form, read, also, load_fleet(fleet).rigs, rig, options)
        told = {"sensors": taken}
    else:
        pairs = format_named(form).pairs(read, options.names_in(files))
        told = {"pairs": sorted(pairs)}
        if also is not None:
            known = read_transforms(also)
            pairs = {pair: known[pair] for pair in ESTIMATED_PAIRS} | pairs
        content = prior_text(pairs, form, list(read))
    write_files({out: content})
    print_summary("import", "done", format=form, files=list(read), **told, outputs=[out])
    return 0


def _of_rig(
    form: str,
    read: Mapping[str, bytes],
    also: Path | None,
    rigs: Mapping[str, Rig],
    name: str | None,
    frames: FrameOptions,
) -> tuple[bytes, list[str]]:
    """Prior file of all sensors of a rig, and which the files have; ConfigError if one is missing or twice."""
    name = next(iter(rigs)) if name is None and len(rigs) == 1 else name or ""
    if name not in rigs:
        raise ConfigError("command line", "rig", f"name one of {', '.join(rigs)} with --rig")
    rig = rigs[name]
    base = {} if rig.base is None else {"base": rig.base}
    names = frames.names(base | noted_frames([Path(file) for file in read]))
    poses = rig_poses(format_named(form), read, names, rig)
    taken = [n.name for n in rig.nodes if n.name in poses]
    if also is not None:
        star, reference = read_star(also, rig), reference_of_rig(rig).name
        of_star = {n.name: between(star, reference, n.name) for n in rig.nodes if n.name != reference}
        poses = {n: T for n, T in of_star.items() if T is not None} | poses
    return star_text(poses, names, rig, form, list(read)), taken

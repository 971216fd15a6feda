"""`boresight import`: a calibration file of another program as a prior."""

from __future__ import annotations

from pathlib import Path

from jobs.frame_options import FrameOptions

__all__ = ["import_prior"]


def import_prior(
    form: str,
    files: list[Path],
    /,
    *,
    out: Path,
    also: Path | None = None,
    frames: FrameOptions | None = None,
) -> int:
    """Make a prior file of what another program wrote.

    Args:
        form: one of the formats of `boresight export`, or vod: View-of-Delft, the lidar's file and the radar's.
        files: all files of the calibration.
        out: prior file to write; fleet.toml takes it as [rigs.*.prior] source = "file", file = "...".
        also: prior file that has the transform which the files lack, where they have no radar.
        frames: what the frames are called in the files.
    """
    from jobs.terminal.summary import print_summary
    from pipeline.export.files import prior_text, read_files, write_files
    from pipeline.export.formats import format_named
    from pipeline.export.tree import ESTIMATED_PAIRS
    from pipeline.extrinsics.prior_file import read_transforms

    read = read_files(files)
    pairs = format_named(form).pairs(read, (frames or FrameOptions()).names_in(files))
    taken = sorted(pairs)
    if also is not None:
        known = read_transforms(also)
        pairs = {pair: known[pair] for pair in ESTIMATED_PAIRS} | pairs
    write_files({out: prior_text(pairs, form, list(read))})
    print_summary("import", "done", format=form, files=list(read), pairs=taken, outputs=[out])
    return 0

"""`boresight export foxglove`: a day's drive with its calibration, for a viewer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import ConfigError

if TYPE_CHECKING:
    from pipeline.export.calibration import ExportedCalibration

__all__ = ["export_foxglove"]


def export_foxglove(
    calibration: ExportedCalibration, location: str, day: str, out: Path, most_frames: int
) -> list[Path]:
    """Write the MCAP `out` and the layout beside it.

    Raises:
        MissingExtraError: foxglove-sdk is not installed.
        ConfigError: no file name, or the lake has no frames of that day.
    """
    from jobs.extras import require

    require("viz")
    if out.suffix != ".mcap":
        raise ConfigError("command line", "out", f"{out} must end in .mcap")
    from pipeline.export.foxglove import TOPICS, write_foxglove
    from pipeline.export.foxglove_table import layout_of
    from pipeline.export.lake import priors_of_day
    from pipeline.export.vehicle_day import read_scenes
    from pipeline.store.atomic_write import atomic_write
    from pipeline.store.partitions import Lake, Partition

    lake = Lake.existing(location)
    found = priors_of_day(lake, calibration.vehicle, day, calibration.method)
    priors = {name: pair.T for name, pair in found.items() if not isinstance(pair, str)}
    scenes = read_scenes(lake, Partition(calibration.vehicle, day), most_frames)
    layout = out.with_suffix(".layout.json")
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(out) as stream:
        write_foxglove(stream, calibration, priors, scenes)
    with atomic_write(layout) as stream:
        stream.write(layout_of(TOPICS, calibration.names))
    return [out, layout]

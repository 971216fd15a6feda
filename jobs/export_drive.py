"""`boresight export foxglove`: a day's drive with its calibration, for a viewer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.export.calibration import ExportedCalibration
    from pipeline.rig.graph import Sensor

__all__ = ["export_foxglove"]


def export_foxglove(
    calibration: ExportedCalibration,
    location: str,
    day: str,
    out: Path,
    most_frames: int,
    sensors: Sequence[str],
) -> list[Path]:
    """Write the MCAP file `out` and a viewer layout next to it.

    Raises:
        MissingExtraError: foxglove-sdk is not installed.
        ConfigError: `out` does not end in .mcap, a sensor does not exist, or the day has no frames.
    """
    from jobs.extras import require
    from jobs.terminal.summary import progress_reporter

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
    known = {name: pair for name, pair in found.items() if not isinstance(pair, str)}
    partition, layout = Partition(calibration.vehicle, day), out.with_suffix(".layout.json")
    shown = _shown(calibration, sensors)
    out.parent.mkdir(parents=True, exist_ok=True)
    if sensors or any(s.name != s.kind for s in shown):
        from pipeline.export.foxglove_rig import layout_of_rig, write_foxglove_rig

        reference = calibration.reference
        before = replace(calibration, pairs=known, known=tuple(pair.edge for pair in known.values()))
        beside = {"lidar": reference.name} if reference.kind == "lidar" else {}
        of_rig = {
            s: read_scenes(
                lake, partition, most_frames, {s.kind: s.name} | (beside if s.kind == "camera" else {})
            )
            for s in shown
        }
        with progress_reporter("export foxglove"), atomic_write(out) as stream:
            write_foxglove_rig(stream, calibration, before, of_rig)
        text = layout_of_rig(shown, reference.name, calibration.names.of(reference.name))
    else:
        priors = {name: pair.T for name, pair in known.items()}
        with progress_reporter("export foxglove"), atomic_write(out) as stream:
            write_foxglove(stream, calibration, priors, read_scenes(lake, partition, most_frames))
        text = layout_of(TOPICS, calibration.names)
    with atomic_write(layout) as stream:
        stream.write(text)
    return [out, layout]


def _shown(calibration: ExportedCalibration, sensors: Sequence[str]) -> list[Sensor]:
    """The sensors with these names, or all without a name; ConfigError if a name is unknown."""
    there = {s.name: s for s in calibration.sensors}
    unknown = [name for name in sensors if name not in there]
    if unknown:
        raise ConfigError(
            "command line", "sensor", f"no {', '.join(unknown)}: the rig has {', '.join(there)}"
        )
    return [there[name] for name in sensors] if sensors else list(there.values())

"""`boresight convert`: public data sets to logs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from jobs.terminal.summary import print_summary, progress_reporter
from pipeline.convert.kitti_shaped import read_kitti, read_view_of_delft
from pipeline.convert.nuscenes import read_nuscenes
from pipeline.convert.recording import fleet_text, write_log
from pipeline.core.errors import ConfigError
from pipeline.rig.graph import Kind
from pipeline.store.partitions import Partition

__all__ = ["convert"]


def convert(
    data_set: Literal["nuscenes", "vod", "kitti"],
    folder: Path,
    /,
    *,
    out: Path,
    vehicle: str | None = None,
    day: str = "2000-01-01",
    camera: str | None = None,
    lidar: str | None = None,
    radar: str | None = None,
    radar_columns: str = "x,y,z,power,doppler",
    segmenter: str | None = None,
    detector: str | None = None,
) -> int:
    """Write OUT/logs/VEHICLE/DAY/*.mcap and OUT/fleet.toml from the folder of a data set.

    Args:
        data_set: nuscenes; vod (View-of-Delft); kitti: folders image_2, velodyne and calib; image_3 and radar
            (with Tr_radar_to_velo in calib) are converted if they exist.
        folder: folder of the data set.
        out: folder to write into.
        vehicle: vehicle id for vod and kitti; default: the data set's name. nuScenes has its own ids and
            days.
        day: day for vod and kitti, which have no stamps, YYYY-MM-DD.
        camera: nuScenes channels, separated by commas; default: all.
        lidar: the same for lidars.
        radar: the same for radars.
        radar_columns: columns of kitti's radar/*.bin (float32); doppler is the range rate, positive =
            receding.
        segmenter: model manifest for fleet.toml, path relative to it; without one, add semantics to
            fleet.toml yourself.
        detector: model manifest for fleet.toml.
    """
    if (segmenter is None) != (detector is None):
        raise ConfigError("command line", "segmenter, detector", "give both or neither")
    models = None if segmenter is None or detector is None else (segmenter, detector)
    owner, messages = vehicle or str(data_set), 0
    Partition(owner, day)  # raises for invalid names
    with progress_reporter("convert") as progress:
        progress(0, 0, f"tables of {folder}")
        if data_set == "nuscenes":
            named: dict[Kind, str | None] = {"camera": camera, "lidar": lidar, "radar": radar}
            recordings = read_nuscenes(folder, {k: c.split(",") for k, c in named.items() if c is not None})
        elif data_set == "vod":
            recordings = read_view_of_delft(folder, owner, day)
        else:
            recordings = read_kitti(folder, owner, day, radar_columns.split(","))
        places = [Partition(r.vehicle, r.day) for r in recordings]  # raises for invalid names
        paths = [
            out / "logs" / p.vehicle / p.day / f"{r.name}.mcap"
            for p, r in zip(places, recordings, strict=True)
        ]
        for done, (path, recording) in enumerate(zip(paths, recordings, strict=True)):
            progress(done, len(paths), recording.name)
            messages += write_log(path, recording)
    vehicles = sorted({r.vehicle for r in recordings})
    kinds = {name: kind for r in recordings for name, kind in r.kinds.items()}
    ego = all(any(e.sensor == "ego" for e in r.events) for r in recordings)
    base = data_set == "nuscenes"  # the others give poses in a sensor's frame
    out.mkdir(parents=True, exist_ok=True)
    fleet = out / "fleet.toml"
    fleet.write_text(fleet_text(data_set, vehicles, kinds, models, ego=ego, base=base))
    print_summary("convert", "done", fleet=fleet, logs=paths, messages=messages)
    return 0

"""`boresight view`: one vehicle-day in 3D."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from jobs.calibration_sources import at_prior, pairs_to, read_calibration
from jobs.extras import require
from jobs.terminal.summary import print_summary
from pipeline.core.errors import ConfigError
from pipeline.store.atomic_write import atomic_write
from pipeline.store.partitions import Lake, Partition
from pipeline.view.layers import Rig, Shown, count_moments, layers_of, read_moment

__all__ = ["view"]


def view(
    *,
    lake: str,
    vehicle: str,
    day: str,
    moment: int | None = None,
    state: Literal["calibrated", "prior", "both"] = "both",
    method: str = "joint",
    out: Path | None = None,
) -> int:
    """Show a moment of a vehicle-day in 3D: sweeps coloured by the cameras, radar with its Doppler, pictures, boxes.

    In the window the space bar changes between prior and calibrated, left and right go to other moments, and a slider
    turns one sensor. Images are shown whole, also where reports hide road users.

    Args:
        lake: folder of the tables.
        vehicle: vehicle id.
        day: YYYY-MM-DD.
        moment: number of the moment, from 0; default: one with many road users.
        state: poses in the picture of --out: calibrated, prior, or both side by side.
        method: calibration method of the records.
        out: PNG to write instead of opening a window.
    """
    require("view")
    from pipeline.view.system import import_open3d, require_display, require_renderer

    if out is not None and out.suffix != ".png":
        raise ConfigError("command line", "out", f"{out} must end in .png")
    import_open3d()
    if out is None:
        require_display()
    require_renderer()
    tables, partition = Lake.existing(lake), Partition(vehicle, day)
    shown = read_moment(tables, partition, moment)
    rig, count = _rig(tables, vehicle, day, method), count_moments(tables, partition)
    if out is not None:
        _draw(rig, shown, f"{vehicle} {day}", state, out)
    else:
        from pipeline.view.draw import quiet_stdout
        from pipeline.view.window import open_window

        def read(number: int) -> Shown | None:
            return read_moment(tables, partition, number) if 0 <= number < count else None

        with quiet_stdout():
            open_window(f"{vehicle} {day}", rig, shown, read)
    without = sorted(set(shown.captures) - set(rig.poses["calibrated"]))
    told = {"vehicle": vehicle, "day": day, "moment": shown.number, "moments": count, "status_of": rig.status}
    print_summary("view", "done", **told, without_pose=without, out=out)
    return 0


def _draw(rig: Rig, shown: Shown, title: str, state: str, out: Path) -> None:
    import cv2

    from pipeline.view.draw import render, viewpoint

    place = viewpoint(rig)
    states = ("prior", "calibrated") if state == "both" else (state,)
    size = (1600 // len(states), 900)
    drawn = [
        render(layers_of(shown, rig, rig.placed(s)), *place, size, f"{title} moment {shown.number}: {s}")
        for s in states
    ]
    done, data = cv2.imencode(".png", np.hstack(drawn)[..., ::-1])
    assert done, "OpenCV encodes every uint8 image"
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(out) as stream:
        stream.write(data.tobytes())


def _rig(lake: Lake, vehicle: str, day: str, method: str) -> Rig:
    """Poses before and after the day; a sensor without an estimate keeps its prior pose; else ConfigError."""
    after = read_calibration(str(lake.root), vehicle, day, method, force=True)
    before = at_prior(after, lake, day)
    reference = after.reference
    prior, calibrated = ({reference.name: np.eye(4)} for _ in range(2))
    status = {}
    for sensor in after.sensors:
        if sensor.name == reference.name:
            continue
        old, new = before.between(reference.name, sensor.name), after.between(reference.name, sensor.name)
        status[sensor.name] = "refused" if new is None else pairs_to(after, sensor.name)[1]
        first, last = old or new, new or old
        if first is not None and last is not None:
            prior[sensor.name], calibrated[sensor.name] = first[0], last[0]
    T_car = after.T_base if after.T_base is not None else _upright(reference.kind)
    return Rig(
        {s.name: s.kind for s in after.sensors}, T_car, {"prior": prior, "calibrated": calibrated}, status
    )


def _upright(kind: str) -> np.ndarray:
    """T_car_reference of a sensor that looks ahead, if its pose on the car is unknown."""
    T = np.eye(4)
    if kind == "camera":
        T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    return T

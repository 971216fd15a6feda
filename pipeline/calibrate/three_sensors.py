"""Choice of one camera, lidar and radar, for the paper's methods, tracking and networks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipeline.core.errors import SolveError
from pipeline.rig.overlap import Overlap, best_three
from pipeline.rig.rig import Rig

__all__ = ["three_sensors"]


def three_sensors(method: str, rig: Rig, overlaps: Sequence[Overlap]) -> Mapping[str, str]:
    """Names by kind: those that the rig names, else the three with the largest overlap; else SolveError."""
    sensors = [node for node in rig.nodes if node.kind != "base"]
    only: Mapping[str, str] = {sensor.kind: sensor.name for sensor in sensors}
    if len(only) == len(sensors):
        return only
    named = rig.three or ()
    among = [o for o in overlaps if not named or {s.name for s in o.edge.sensors} <= set(named)]
    best = best_three(among)
    if best is None:
        which = "no three of the rig do"
        if named:
            which = f"{', '.join(named[:2])} and {named[2]} share none, name others as three of the rig"
        raise SolveError(f"method {method} works on a camera, a lidar and a radar that share a view: {which}")
    return {sensor.kind: sensor.name for sensor in best}

"""Mounts that radars report themselves: what tells a shared error of sensors from one of all mounts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow.compute as pc
from jaxtyping import Float

from pipeline.audit.line_days import Key
from pipeline.store.current import current_rows
from pipeline.store.partitions import Lake
from pipeline.store.records import read_columns
from schemas.radar_alignments import RADAR_ALIGNMENTS

__all__ = ["Reports", "Witnesses", "reports_of_radars", "witnesses_of"]

_ANGLES = ("azimuth", "elevation")
_OF_RADARS = (
    "vehicle", "sensor", "day", "sign_is_published",
    *(f"{name}_{what}" for name in _ANGLES for what in ("rad", "sigma_rad", "scatter_rad")),
)  # fmt: skip
_SUREST_RAD = float(np.radians(0.05))  # a radar's own alignment is not taken to be surer


@dataclass(frozen=True, eq=False)
class Witnesses:
    """Mounts that radars report themselves: by name of a shared axis, angle [rad] and inverse variance by vehicle."""

    value: dict[str, Float[np.ndarray, " N"]]
    information: dict[str, Float[np.ndarray, " N"]]


Reports = dict[tuple[str, str], dict[str, list[tuple[str, float, float]]]]  # of days


def reports_of_radars(lake: Lake, method: str, window: tuple[str, str]) -> Reports:
    """Angles and sigmas that radars report of their own mounts, by vehicle and radar, where their signs are known."""
    table = read_columns(lake, RADAR_ALIGNMENTS, _OF_RADARS, first=window[0], last=window[1])
    found: Reports = {}
    if table is None:
        return found
    rows = current_rows(table.filter(pc.equal(table["method"], method)), RADAR_ALIGNMENTS)
    for row in rows.select(list(_OF_RADARS)).to_pylist():
        if not row["sign_is_published"]:
            continue
        for name in _ANGLES:
            if row[f"{name}_rad"] is not None:
                sizes = (row[f"{name}_sigma_rad"] or 0.0, row[f"{name}_scatter_rad"] or 0.0, _SUREST_RAD)
                of = found.setdefault((row["vehicle"], row["sensor"]), {})
                of.setdefault(f"radar {name}", []).append((row["day"], row[f"{name}_rad"], max(sizes)))
    return found


def witnesses_of(reports: Reports, keys: Sequence[Key], since: Callable[[Key], str]) -> Witnesses:
    """Mean of each vehicle's reports since it changed; their errors are taken to be the same every day."""
    value = {f"radar {name}": np.zeros(len(keys)) for name in _ANGLES}
    information = {name: np.zeros(len(keys)) for name in value}
    for k, (vehicle, edge) in enumerate(keys):
        radars = [sensor.name for sensor in (edge.parent, edge.child) if sensor.kind == "radar"]
        of_radar = reports.get((vehicle, radars[0]), {}) if len(radars) == 1 else {}
        for name, days in of_radar.items():
            own = [(angle, sigma) for day, angle, sigma in days if day >= since((vehicle, edge))]
            if not own:
                continue
            angle, sigma = np.array(own).mean(axis=0)
            value[name][k], information[name][k] = angle, 1 / sigma**2
    return Witnesses(value, information)

"""Content of the 3D view: one moment of a vehicle-day, and the sensors' poses before and after calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import ConfigError
from pipeline.rig.se3 import exp_so3
from pipeline.store.moments import joined, sensors_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_rows
from pipeline.store.views import ingested, perceived
from schemas.captures import Image, Scan, Sweep
from schemas.moments import MOMENTS, PERCEIVED, Moment, Perceived

__all__ = ["AXES", "STATES", "Rig", "Shown", "count_moments", "read_moment"]

STATES = ("calibrated", "prior")
# Turns of a sensor by hand are about these axes of the car: x forward, y left, z up.
AXES = {"roll": (1.0, 0.0, 0.0), "pitch": (0.0, 1.0, 0.0), "yaw": (0.0, 0.0, 1.0)}
_LOOKED_AT = 12  # moments, spread over the day, of which the one with most road users is shown


@dataclass(frozen=True, eq=False)
class Rig:
    """Kinds of sensors, T_car_reference (drawing's axes), poses by state (prior, calibrated), status."""

    kinds: Mapping[str, str]
    T_car_reference: Float[np.ndarray, "4 4"]
    poses: Mapping[str, Mapping[str, Float[np.ndarray, "4 4"]]]
    status: Mapping[str, str]

    def placed(
        self, state: str, turned: str | None = None, axis: str = "yaw", angle_rad: float = 0.0
    ) -> dict[str, Float[np.ndarray, "4 4"]]:
        """T_car_sensor by sensor; one sensor is rotated about an axis of the car through the sensor's origin."""
        placed = {name: self.T_car_reference @ T for name, T in self.poses[state].items()}
        if turned in placed:
            T = placed[turned].copy()
            T[:3, :3] = exp_so3(angle_rad * np.array(AXES[axis])) @ T[:3, :3]
            placed[turned] = T
        return placed


@dataclass(frozen=True, eq=False)
class Shown:
    """A moment: its number and the total, data and features by sensor."""

    number: int
    stamp_ns: int
    captures: Mapping[str, Image | Sweep | Scan]
    found: Mapping[str, Any]


def count_moments(lake: Lake, partition: Partition) -> int:
    """Moments of a vehicle-day; raises ConfigError if the lake has none."""
    manifest = ingested(lake, partition)
    if manifest is None or not manifest.rows:
        problem = f"the lake has no moments of {partition.vehicle} {partition.day}: run `boresight ingest`"
        raise ConfigError("command line", "day", problem)
    return manifest.rows


def read_moment(lake: Lake, partition: Partition, number: int | None = None) -> Shown:
    """One moment with all its sensors; number None = of the moments with most sensors, one with many road users.

    Raises:
        ConfigError: the day has no such moment.
        DamagedError, CollectedError: a file is damaged, or was deleted after its retention.
    """
    count = count_moments(lake, partition)
    chosen = _rich_moment(lake, partition) if number is None else number
    if not 0 <= chosen < count:
        raise ConfigError("command line", "moment", f"{chosen}: the day has moments 0 to {count - 1}")
    [(moment, captures)] = joined(lake, MOMENTS, partition, None, [chosen])
    found = next((rows for _, rows in joined(lake, PERCEIVED, partition, None, [chosen])), {}) if (
        perceived(lake, partition) is not None
    ) else {}  # fmt: skip
    return Shown(chosen, moment.stamp_ns, captures, found)


def _rich_moment(lake: Lake, partition: Partition) -> int:
    """Of some moments with most sensors, spread over the day, the one with most road users."""
    manifest = perceived(lake, partition)
    schema, kind = (MOMENTS, Moment) if manifest is None else (PERCEIVED, Perceived)
    moments: list[Any] = read_rows(lake, schema, partition, kind)
    if not moments:
        return 0
    most = max(len(m.rows) for m in moments)
    whole = [m.moment for m in moments if len(m.rows) == most]
    if manifest is None:
        return int(whole[len(whole) // 2])
    some = sorted({whole[round(i)] for i in np.linspace(0, len(whole) - 1, _LOOKED_AT)})
    seeing = [name for name, kind in sensors_of(manifest).items() if kind == "camera"]
    seen = joined(lake, PERCEIVED, partition, seeing, some)
    users = {m.moment: sum(len(row.road_user_classes) for row in rows.values()) for m, rows in seen}
    return int(max(some, key=lambda number: users.get(number, 0)))

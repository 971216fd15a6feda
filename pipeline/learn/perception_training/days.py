"""Vehicle-days of a lake for training perception's networks, and which of them are held out."""

from __future__ import annotations

from pipeline.core.config import FleetConfig
from pipeline.core.errors import ContractError
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import perceived_days

__all__ = ["is_held_out", "vehicle_days"]

_HELD_OUT_EVERY = 5  # vehicle-days


def vehicle_days(fleet: FleetConfig, lake: Lake, least: int) -> list[Partition]:
    """Perceived vehicle-days of the fleet; raises ContractError if there are fewer than `least`."""
    days = [p for p in perceived_days(lake) if fleet.knows(p.vehicle)]
    if len(days) < least:
        problem = f"{len(days)} vehicle-days with observations of vehicles in fleet.toml, {least} needed"
        raise ContractError(str(lake.root), f"{problem}: run `boresight perceive`")
    return days


def is_held_out(number: int) -> bool:
    """Whether the vehicle-day of this number is: the second day already, so that two days are enough."""
    return number % _HELD_OUT_EVERY == 1

"""File names of pages: readable, and unique on any file system."""

from __future__ import annotations

import re

from pipeline.core.config import config_hash

__all__ = ["page_name", "page_stem"]

_PLAIN = re.compile(r"[a-z0-9_-][a-z0-9._-]*[a-z0-9_-]|[a-z0-9_-]")
# Names that Windows keeps for devices, whatever follows the first dot.
_DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?")
_READABLE = 60  # letters of an odd name that are kept; what a name differs in may come later


def page_stem(vehicle: str) -> str:
    """File name of a vehicle's pages, without the ending: the vehicle's name if that is plain.

    Some file systems do not distinguish case, accents and signs ("Car" and "car", "a b" and "a_b"). Such a
    name gets "~" and a hash of the whole name; no plain name has a "~".
    """
    if _PLAIN.fullmatch(vehicle) and not _DEVICES.fullmatch(vehicle):
        return vehicle
    readable = re.sub(r"[^a-z0-9_-]", "_", vehicle.lower())[:_READABLE]
    return f"{readable}~{config_hash({'vehicle': vehicle})[:12]}"


def page_name(vehicle: str, day: str) -> str:
    """A vehicle-day's page, relative to the folder of the days' pages."""
    return f"{day}/{page_stem(vehicle)}.html"

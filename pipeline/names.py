"""Names that become folders of the lake and files of the report: what a vehicle may be called."""

from __future__ import annotations

import re
import unicodedata
from urllib.parse import quote

__all__ = ["is_vehicle"]

_VEHICLE = re.compile(r"[^/\0=]+")
_LONGEST_FOLDER = 200  # of the 255 bytes that file systems allow: pages and partitions add to the name


def is_vehicle(name: str) -> bool:
    """Whether a name can be a vehicle's: no control characters, path or "=", and short enough for a folder."""
    return (
        bool(_VEHICLE.fullmatch(name))
        and name not in (".", "..")
        and not any(unicodedata.category(letter) in ("Cc", "Cs") for letter in name)
        and len(quote(name, safe="")) <= _LONGEST_FOLDER
    )

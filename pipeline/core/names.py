"""Names of vehicles, which become folders of the lake and files of the report."""

from __future__ import annotations

import re
import unicodedata
from urllib.parse import quote

__all__ = ["is_pattern", "is_vehicle", "matches"]

_VEHICLE = re.compile(r"[^/\0=]+")
_WILD = {"*": ".*", "?": "."}
_LONGEST_FOLDER = 200  # of the 255 bytes that file systems allow; pages and partitions extend the name


def is_vehicle(name: str) -> bool:
    """Whether a vehicle may have this name: no control characters, "/" or "=", not too long."""
    return (
        bool(_VEHICLE.fullmatch(name))
        and name not in (".", "..")
        and not any(unicodedata.category(letter) in ("Cc", "Cs") for letter in name)
        and len(quote(name, safe="")) <= _LONGEST_FOLDER
    )


def is_pattern(name: str) -> bool:
    """Whether a name in fleet.toml is a pattern for vehicles."""
    return any(letter in name for letter in _WILD)


def matches(pattern: str, vehicle: str) -> bool:
    """Whether a vehicle's name matches a pattern: * for any number of letters, ? for one."""
    wild = "".join(_WILD.get(letter, re.escape(letter)) for letter in pattern)
    return re.fullmatch(wild, vehicle) is not None

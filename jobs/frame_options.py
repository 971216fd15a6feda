"""Frame names on the command line, for all commands that read or write calibration files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import FrameNames
from pipeline.export.files import noted_frames

__all__ = ["FrameOptions"]

_KINDS = ("camera", "lidar", "radar", "base")


@Parameter(name="*")
@dataclass(frozen=True)
class FrameOptions:
    """Frame names in the file; default: the names in the car's logs, otherwise the names of the sensors."""

    camera: Annotated[
        str | None, Parameter(name="--camera-frame", help="optical frame (Autoware: the link)")
    ] = None
    lidar: Annotated[str | None, Parameter(name="--lidar-frame", help="frame of the lidar")] = None
    radar: Annotated[str | None, Parameter(name="--radar-frame", help="frame of the radar")] = None
    base: Annotated[str | None, Parameter(name="--base-frame", help="frame of the car, of --mount")] = None
    frame: Annotated[
        tuple[str, ...],
        Parameter(name="--frame", help="SENSOR=NAME, of any sensor; again for each", negative=()),
    ] = ()

    def names(self, known: Mapping[str, str] | None = None) -> FrameNames:
        """Frame names for the pipeline; `known` has names for frames without an option; else ConfigError."""
        asked = {s: n for s in _KINDS if (n := getattr(self, s)) is not None}
        for text in self.frame:
            sensor, equals, name = text.partition("=")
            if not (sensor and equals and name):
                raise ConfigError("command line", "frame", f"{text!r} is not SENSOR=NAME, as front=cam_front")
            asked[sensor] = name
        return FrameNames.named({**(known or {}), **asked})

    def names_in(self, files: Iterable[str | Path]) -> FrameNames:
        """Frame names for reading files: from options, else from an export's notes in or beside them."""
        return self.names(noted_frames([Path(file) for file in files]))

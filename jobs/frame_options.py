"""Names of frames on the command line, the same for every command that reads or writes calibration files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

if TYPE_CHECKING:
    from pipeline.export.calibration import FrameNames

__all__ = ["FrameOptions"]


@Parameter(name="*")
@dataclass(frozen=True)
class FrameOptions:
    """What the frames are called in the file."""

    camera: Annotated[str, Parameter(name="--camera-frame", help="optical frame (Autoware: the link)")] = (
        "camera"
    )
    lidar: Annotated[str, Parameter(name="--lidar-frame", help="frame of the lidar")] = "lidar"
    radar: Annotated[str, Parameter(name="--radar-frame", help="frame of the radar")] = "radar"
    base: Annotated[str, Parameter(name="--base-frame", help="frame of the car, of --mount")] = "base_link"

    def names(self) -> FrameNames:
        """The same for the pipeline.

        Raises:
            ConfigError: no names of frames.
        """
        from pipeline.export.calibration import FrameNames

        return FrameNames(**asdict(self))

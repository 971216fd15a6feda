"""Names of the faults that records can state, so that programs need not read their sentences."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

__all__ = ["FAULTS", "in_words"]

FAULTS: Final = {
    "camera_info": "the camera's intrinsics differ from its CameraInfo",
    "configuration": "fleet.toml, or a file that it names, must be mended: no other log helps",
    "doppler": "the sign, the unit or the period of the radar's Doppler is not as configured",
    "few_scenes": "the day shows too few different scenes",
    "labels_offset": "semantic labels lie beside the picture that they belong to",
    "memory": "the day's logs ask for more memory than a worker may take",
    "model_output": "a perception model returns values that cannot be right",
    "moved_in_day": "a sensor moved during the day",
    "no_labels": "there are no semantic labels of a camera",
    "odometry": "the odometry contradicts the other sources of motion",
    "orientation": "a sensor points elsewhere than its prior says by far",
    "prior": "the prior of a sensor's pose contradicts the day by many of its sigmas",
    "silent_sensor": "a sensor delivered no usable data",
    "stuck_sensor": "a sensor repeats the same data under new stamps",
    "time_offset": "a clock is further off than is plausible",
    "unit": "a sensor's points are in another unit than metres",
    "witnesses_disagree": "independent parts of the evidence contradict each other",
}


def in_words(faults: Iterable[str]) -> str:
    """Faults as sentences; a name that this release does not know stays as it is."""
    return "; ".join(FAULTS.get(fault, fault) for fault in faults)

"""Names of faults in records, so that programs need not parse reasons."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

__all__ = ["FAULTS", "in_words"]

FAULTS: Final = {
    "camera_info": "the camera's intrinsics differ from its CameraInfo",
    "configuration": "fleet.toml, a file that it names, or the recording must be corrected: no other log helps",
    "doppler": "the sign, unit or period of the radar's Doppler differs from the configuration",
    "few_scenes": "the day has too few different scenes",
    "labels_offset": "semantic labels are shifted against their image",
    "memory": "the day's logs need more memory than a worker may use",
    "model_output": "a perception model returns impossible values",
    "moved_in_day": "a sensor moved during the day",
    "no_labels": "a camera has no semantic labels",
    "odometry": "odometry contradicts the other sources of motion",
    "orientation": "a sensor points far from the direction of its prior",
    "prior": "the prior of a sensor's pose differs from the day by many sigmas",
    "silent_sensor": "a sensor delivered no usable data",
    "stuck_sensor": "a sensor repeats the same data under new stamps",
    "time_offset": "a clock offset is implausibly large",
    "unit": "a sensor's points are not in metres",
    "witnesses_disagree": "independent parts of the evidence contradict each other",
}


def in_words(faults: Iterable[str]) -> str:
    """Faults as sentences; an unknown name is returned unchanged."""
    return "; ".join(FAULTS.get(fault, fault) for fault in faults)

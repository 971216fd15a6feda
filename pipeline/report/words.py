"""Numbers and statuses in words: degrees and metres, axes by their names; the sentences that answer, in one list."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.rig.se3 import to_quaternion
from schemas.calibrations import DOF_NAMES, FRAMES_OF_PAIR
from schemas.drift import DriftFinding
from schemas.words import AXIS_NAMES

__all__ = [
    "ANSWERS",
    "LEFT_OUT",
    "PAIR_TITLES",
    "dof_title",
    "kind_of_sensor",
    "motion_in_words",
    "pose_text",
    "scaled",
    "sigma_text",
    "unit_of",
    "with_sigma",
]

# Reasons of pipeline/calibrate/select/frames.py that need more words than their names.
LEFT_OUT = {
    "held_out": "held out to check the result",
    "next_to_held_out": "too near in time to a held-out frame",
    "not_needed": "same scenes as frames that are used",
    "sync": "stamps too far apart",
    "empty": "nothing to align",
}

PAIR_TITLES = {pair: "-".join(frames) for pair, frames in FRAMES_OF_PAIR.items()}
_CLEAR_SIGMAS = 3.0


def unit_of(dof: str) -> str:
    """Unit on pages: degrees for rotations."""
    return "deg" if dof.startswith("r") else "m"


def scaled(value: float, dof: str) -> float:
    """A value in its unit on pages."""
    return float(np.degrees(value)) if dof.startswith("r") else float(value)


def with_sigma(value: float, sigma: float, dof: str) -> str:
    """As `+1.02 ± 0.05 deg`, with the digits that are significant for this sigma."""
    v, s = scaled(value, dof), scaled(sigma, dof)
    digits = int(np.clip(1 - np.floor(np.log10(max(s, 1e-9))), 1, 4))
    return f"{v:+.{digits}f} ± {s:.{digits}f} {unit_of(dof)}"


def dof_title(pair: str, dof: str) -> str:
    """As `yaw`, along the axes of the parent of an edge of this kind."""
    return AXIS_NAMES[pair.partition("_")[0]][DOF_NAMES.index(dof)]


def motion_in_words(kind: str, motion: list[float], sigma: list[float]) -> str:
    """Significant components, the clearest first, as `yaw +1.02 ± 0.05 deg`, in axes of this kind of sensor."""
    ratio = np.abs(motion) / np.maximum(sigma, 1e-12)
    shown = [k for k in np.argsort(-ratio).tolist() if ratio[k] >= _CLEAR_SIGMAS]
    parts = [f"{AXIS_NAMES[kind][k]} {with_sigma(motion[k], sigma[k], DOF_NAMES[k])}" for k in shown]
    return ", ".join(parts) or "no single axis is significant"


def pose_text(T: np.ndarray | None) -> str:
    """Quaternion (w, x, y, z) and translation of a pose, with all digits that matter to a car."""
    if T is None:
        return ""
    numbers = [f"{v:.6f}" for v in to_quaternion(T)], [f"{v:.4f}" for v in T[:3, 3]]
    return f"{' '.join(numbers[0])}; {' '.join(numbers[1])} m"


def sigma_text(row: Mapping[str, Any]) -> str:
    """Sigmas of azimuth and elevation of a state."""
    if row["azimuth_sigma_rad"] is None:
        return ""
    azimuth, elevation = np.degrees([row["azimuth_sigma_rad"], row["elevation_sigma_rad"]])
    return f"{azimuth:.3f} / {elevation:.3f}"


def kind_of_sensor(name: str, findings: Sequence[DriftFinding]) -> str:
    """Kind of a sensor (camera, lidar, radar or base), from the edges in its vehicle's findings."""
    known = {
        frame: kind
        for f in findings
        for frame, kind in zip((f.parent_frame, f.child_frame), f.pair.split("_"), strict=True)
    }
    return known.get(name, name)


# First sentences of pages. Of a day: may its numbers go on the car?
ANSWERS = {
    "moved since": "Not any more. The {sensor} moved on {since}, after this day.",
    "moved since, others": " Only {titles} still holds.",
    "moved, accepted": "Only {titles} may be used.",
    "moved": "{first} The {sensor} moved on {since}, this day was not accepted: no calibration of {titles} is valid.",
    "nothing": "No. Nothing was accepted: keep the transforms that the car has.",
    "all": "Yes. All {what} are accepted: they may go on the car, with the sigmas below.",
    "partly": "Partly. Accepted: {titles}. Keep what the car has for {others}.",
    # Of a day that shows tonight's state: may it be loaded?
    "state, nothing": "No. Nothing in tonight's state is certified: keep what the car has.",
    "state, all": "Yes. Load tonight's state: all sensors are certified.",
    "state, all in one": "Yes. Load tonight's state: all sensors are certified, in azimuth or elevation at least.",
    "state, partly": "Partly. Load tonight's state. Certified: {titles}.",
    "used": " Used, but not certified: {titles}.",
    "at prior": " At the prior: {titles}.",
    "in one": " Certified in {one} only: {titles}.",
    # Of the fleet: did a sensor move?
    "no audit": "No audit yet: run `boresight audit`.",
    "GREEN": "No sensor moved on {vehicles}.",
    "UNKNOWN": "No change found, but on {vehicles} more days are required to exclude one above the limit.",
    "RED": "A sensor moved on {vehicles}: {named}.",
    "YELLOW": "A sensor may have moved on {vehicles}: {named}.",
    "YELLOW too": " A sensor may have moved on {more} more.",
    # Of the calibration in use: is it right?
    "right": "Yes, within the limits",
    "wrong": "No",
    "inconclusive": "Undecided: this log is not sufficient",
    "wrong sensor": "Wrong: {error}.",
    "open": "This log does not determine: {axes}.",
    "passes": "Every axis that is judged passes.",
}

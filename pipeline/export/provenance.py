"""Provenance of an exported file: frames, uncertainty, origin, and warnings."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.core.results import plain
from pipeline.export.calibration import (
    USABLE,
    ExportedCalibration,
    ExportedPair,
    Pose,
    poses_of,
    replaced_transforms,
    sigmas_of,
)
from pipeline.rig.graph import BASE
from schemas.words import axes_in_words

__all__ = ["comment_lines", "not_certified", "provenance_of", "used_lines", "warnings_of"]

_AXES = {
    "camera": "optical: x right, y down, z forward",
    "lidar": "x forward, y left, z up",
    "radar": "x forward, y left, z up",
}
_CONVENTION = (
    "T_a_b maps coordinates from frame b to frame a: p_a = T_a_b p_b. Metres, radians. Covariances are of the left "
    "perturbation exp(xi) T, xi = rx ry rz tx ty tz along the axes of a; sigmas of the rotation about these axes and "
    "of the position of b's origin."
)
_DIRECTIONS = ("azimuth", "elevation")


def provenance_of(calibration: ExportedCalibration) -> dict[str, Any]:
    """All information on a calibration in plain values, for a side file or a format's metadata."""
    names = (*(sensor.name for sensor in calibration.sensors), BASE.name)
    found: dict[str, Any] = {
        "written_by": f"Boresight {calibration.code_version}",
        "vehicle": calibration.vehicle,
        "source": calibration.source,
        "method": calibration.method,
        "warnings": warnings_of(calibration),
        "convention": _CONVENTION,
        "frames": _frames(calibration),
        "frame_names": {name: calibration.names.of(name) for name in names},
        "poses": [
            {
                "parent": p.parent,
                "child": p.child,
                "T_parent_child": p.T,
                "sigma": sigmas_of(p.T, p.covariance),
            }
            for p in poses_of(calibration)
        ],
        "pairs": {name: _pair(pair) for name, pair in calibration.pairs.items()},
        "left_out": calibration.left_out,
        "replaces_in_tf_static": replaced_transforms(calibration),
    }
    return {name: plain(value) for name, value in found.items()}


def warnings_of(calibration: ExportedCalibration) -> list[str]:
    """Warnings, a sentence each: what is left out, at the prior or not certified, and the car's own transforms."""
    found = [f"{pair} is left out: {reason}" for pair, reason in calibration.left_out.items()]
    for pair in calibration.pairs.values():
        if pair.status not in USABLE:
            found.append(f"{pair.pair} is {pair.status.upper()}, check it before loading: {pair.reason}")
        elif pair.reason and (pair.status == "prior" or len(pair.certified) < len(_DIRECTIONS)):
            found.append(f"{pair.pair}: {pair.reason}")
    replaced = replaced_transforms(calibration)
    if replaced:
        found.append(
            f"a frame has one parent: remove from the car's own /tf_static what this replaces: {', '.join(replaced)}"
        )
    return [" ".join(words.split()) for words in found]


def used_lines(calibration: ExportedCalibration) -> list[str]:
    """For each pair one line: axes that are used, certified directions, axes at the prior."""
    return [f"{pair.pair}: {_used(pair)}" for pair in calibration.pairs.values()]


def _used(pair: ExportedPair) -> str:
    return axes_in_words(pair.edge.parent.kind, pair.observable, pair.certified)


def not_certified(calibration: ExportedCalibration) -> dict[str, str]:
    """Reason by pair why not all of it is reliable; empty if all pairs are accepted and certified."""
    found = dict(calibration.left_out)
    for name, pair in calibration.pairs.items():
        if pair.status == "prior":
            found[name] = pair.reason
        elif pair.status not in USABLE:
            found[name] = f"{pair.status}: {pair.reason}"
        elif missing := [d for d in _DIRECTIONS if d not in pair.certified]:
            found[name] = f"{' and '.join(missing)} not certified"
    return found


def comment_lines(calibration: ExportedCalibration, camera_axes: str | None = None) -> list[str]:
    """Provenance and warnings as printable single lines, for formats with comments.

    `camera_axes` describes the format's camera frame, if it is not the optical frame.
    """
    frames = _frames(calibration)
    if camera_axes is not None:
        cameras = [s.name for s in calibration.sensors if s.kind == "camera"]
        frames |= {calibration.names.of(name): camera_axes for name in cameras}
    lines = [
        f"Boresight {calibration.code_version}: {calibration.vehicle}, {calibration.source}, {calibration.method}",
        *used_lines(calibration),
        *(f"WARNING: {words}" for words in warnings_of(calibration)),
        *(f"frame {name}: {axes}" for name, axes in frames.items()),
    ]
    for edge in poses_of(calibration):
        sure = "as given" if edge.covariance is None else f"sigma {_in_words(edge)}"
        lines.append(f"{edge.parent} -> {edge.child}: pose of {edge.child} in {edge.parent}; {sure}")
    return ["".join(c if c.isprintable() else " " for c in line) for line in lines]


def _frames(calibration: ExportedCalibration) -> dict[str, str]:
    names = calibration.names
    axes = {names.of(sensor.name): _AXES[sensor.kind] for sensor in calibration.sensors}
    if calibration.T_base is None:
        axes[names.of(calibration.reference.name)] += "; the root: its pose on the car is unknown"
    else:
        axes[names.of(BASE.name)] = "x forward, y left, z up; the root"
    return axes


def _in_words(edge: Pose) -> str:
    sigmas = list((sigmas_of(edge.T, edge.covariance) or {}).values())
    turn = " ".join(f"{v:.4f}" for v in np.degrees(sigmas[:3]))
    shift = " ".join(f"{v:.4f}" for v in sigmas[3:])
    return f"{turn} deg about and {shift} m along the axes of {edge.parent}"


def _pair(pair: ExportedPair) -> dict[str, Any]:
    return {
        "status": pair.status,
        "reason": pair.reason,
        "certified": pair.certified,
        "kept_at_prior": pair.at_prior,
        "in_words": _used(pair),
        f"T_{pair.identifier}": pair.T,
        "sigma": sigmas_of(pair.T, pair.covariance),
        "covariance": pair.covariance,
        **pair.details,
    }

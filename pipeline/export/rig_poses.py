"""Poses of all sensors of a rig, by sensor name, from files of any format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import FrameNames
from pipeline.export.formats import Files, Format
from pipeline.export.texts import to_json
from pipeline.rig.edges import words_of
from pipeline.rig.graph import Edge, Sensor, tie
from pipeline.rig.prior import middle_of
from pipeline.rig.rig import Rig
from pipeline.rig.se3 import inverse

__all__ = ["from_ties", "reference_of_rig", "require_all", "rig_poses", "star_text"]


def reference_of_rig(rig: Rig) -> Sensor:
    """Reference sensor of the poses: from fleet.toml, else the first lidar, radar or camera."""
    return next((n for n in rig.nodes if n.name == rig.reference), None) or middle_of(rig.nodes)


def rig_poses(form: Format, files: Files, names: FrameNames, rig: Rig) -> dict[str, Float[np.ndarray, "4 4"]]:
    """T_reference_sensor by name, for the sensors and base of the rig that the files contain.

    Raises:
        ConfigError: the files contain none, or one twice; the message has file and field.
    """
    reference = reference_of_rig(rig)
    ties = {words_of(edge): edge for n in rig.nodes if n != reference for edge in (tie(n, reference),)}
    found = form.pairs(files, names, list(ties.values()))
    return from_ties({ties[words]: T for words, T in found.items()}, reference)


def from_ties(ties: Mapping[Edge, np.ndarray], reference: Sensor) -> dict[str, Float[np.ndarray, "4 4"]]:
    """T_reference_sensor by sensor name, from T_parent_child of edges to the reference."""
    return {
        edge.other(reference.name).name: T if edge.parent == reference else inverse(T)
        for edge, T in ties.items()
    }


def require_all(
    poses: Mapping[str, np.ndarray], files: Sequence[str], names: FrameNames, rig: Rig
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """The poses in the rig's order; raises ConfigError that lists sensors that are missing."""
    reference = reference_of_rig(rig)
    missing = [n.name for n in rig.nodes if n != reference and n.name not in poses]
    if missing:
        frames = ", ".join(f"{n} (frame {names.of(n)})" if names.of(n) != n else n for n in missing)
        problem = (
            f"missing: {frames}; name their frames with --frame SENSOR=NAME, or give a prior file that has them with "
            "--also"
        )
        raise ConfigError(", ".join(files), "sensors", problem)
    return {n.name: poses[n.name] for n in rig.nodes if n != reference}


def star_text(poses: Mapping[str, np.ndarray], rig: Rig, form: str, files: Sequence[str]) -> bytes:
    """Prior file (`[rigs.*.prior] source = "file"`) with these poses."""
    T = {name: np.asarray(pose).tolist() for name, pose in poses.items()}
    origin = {"format": form, "files": list(files)}
    return to_json({"reference": reference_of_rig(rig).name, "T": T, "imported_from": origin})

"""Files of a format on disk: paths, side file, poses of a rig, and the prior file of an import."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, FrameNames
from pipeline.export.formats import Files, Format
from pipeline.export.provenance import provenance_of
from pipeline.export.texts import to_json
from pipeline.export.tree import ESTIMATED_PAIRS
from pipeline.rig.graph import Edge, Sensor, tie, words_of
from pipeline.rig.prior import middle_of
from pipeline.rig.rig import Rig
from pipeline.rig.se3 import inverse
from pipeline.store.atomic_write import atomic_write

__all__ = [
    "SIDE_FILE",
    "from_ties",
    "noted_frames",
    "prior_text",
    "read_files",
    "reference_of_rig",
    "rig_poses",
    "star_text",
    "updated_file",
    "write_files",
    "written_files",
]

SIDE_FILE = ".provenance.json"
_MOST_BYTES = 1 << 30  # a calibration has kilobytes; a log that is read for /tf_static may be larger


def written_files(form: Format, calibration: ExportedCalibration, out: Path) -> dict[Path, bytes]:
    """Content by path: `out` itself for a format of one file and `out` with a suffix, else files in it."""
    if form.write is None:
        raise ConfigError("command line", "format", f"{form.name} can only be imported")
    files = form.write(calibration)
    is_one = len(files) == 1 and out.suffix != "" and not out.is_dir()
    found = {out if is_one else out / name: content for name, content in files.items()}
    if not form.holds_provenance:
        notes = {"format": form.name, "notes": list(form.notes)}
        found[_beside(next(iter(found)))] = to_json(provenance_of(calibration) | notes)
    return found


def _beside(path: Path) -> Path:
    return path.with_name(path.name.partition(".")[0] + SIDE_FILE)


def updated_file(
    form: Format, calibration: ExportedCalibration, template: Path, out: Path
) -> dict[Path, bytes]:
    """Content by path: the user's file with new poses, written as `out`, and the side file."""
    if form.update is None:
        raise ConfigError("command line", "update", f"{form.name} does not support --update")
    [(name, content)] = read_files([template]).items()
    text, changed = form.update(name, content, calibration)
    side = provenance_of(calibration) | {"format": form.name, "updated": changed}
    return {out: text, _beside(out): to_json(side)}


def write_files(files: Mapping[Path, bytes]) -> None:
    """Write each file atomically; make the folders."""
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as stream:
            stream.write(content)


def read_files(paths: Sequence[Path]) -> dict[str, bytes]:
    """Content by path, without side files; raises ConfigError if a file cannot be read."""
    found = {}
    for path in paths:
        if path.name.endswith(SIDE_FILE):
            continue
        try:
            if path.stat().st_size > _MOST_BYTES:
                raise ConfigError(str(path), "", f"is larger than {_MOST_BYTES >> 30} GiB")
            found[str(path)] = path.read_bytes()
        except OSError as err:
            raise ConfigError(str(path), "", f"cannot be read: {err.strerror}") from err
    if not found:
        raise ConfigError("command line", "files", "none given")
    return found


def noted_frames(paths: Sequence[Path]) -> dict[str, str]:
    """Frame of each sensor as noted by an export, in the files or beside them; empty if there is no note."""
    for path in paths:
        for file in (_beside(path), path):
            if file.suffix == ".json" and file.is_file() and file.stat().st_size <= _MOST_BYTES:
                with suppress(ValueError):
                    found = _within(json.loads(file.read_bytes()), "frame_names")
                    if isinstance(found, dict):
                        return {str(sensor): str(name) for sensor, name in found.items()}
    return {}


def _within(content: object, key: str) -> object:
    """Value of a key at any depth; None if there is none."""
    if isinstance(content, dict):
        return content[key] if key in content else _within(list(content.values()), key)
    if isinstance(content, list):
        return next((found for part in content if (found := _within(part, key)) is not None), None)
    return None


def prior_text(pairs: Mapping[str, np.ndarray], form: str, files: Sequence[str]) -> bytes:
    """Prior file of both transforms, bit for bit; raises ConfigError if a transform is missing."""
    missing = [pair for pair in ESTIMATED_PAIRS if pair not in pairs]
    if missing:
        problem = "missing, but a prior needs it: give a prior file that has it with --also"
        raise ConfigError(", ".join(files), f"T_{missing[0]}", problem)
    transforms = {f"T_{pair}": pairs[pair] for pair in ESTIMATED_PAIRS}
    return to_json(transforms | {"imported_from": {"format": form, "files": files}})


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


def star_text(
    poses: Mapping[str, np.ndarray], names: FrameNames, rig: Rig, form: str, files: Sequence[str]
) -> bytes:
    """Prior file (`[rigs.*.prior] source = "file"`) with T_reference_sensor of a whole rig, in the rig's order.

    Raises:
        ConfigError: with the names of the sensors that are missing.
    """
    reference = reference_of_rig(rig)
    others = [n.name for n in rig.nodes if n != reference]
    missing = [name for name in others if name not in poses]
    if missing:
        frames = ", ".join(f"{n} (frame {names.of(n)})" if names.of(n) != n else n for n in missing)
        problem = (
            f"missing: {frames}; name their frames with --frame SENSOR=NAME, or give a prior file that has them with "
            "--also"
        )
        raise ConfigError(", ".join(files), "sensors", problem)
    T = {name: poses[name] for name in others}
    return to_json({"reference": reference.name, "T": T, "imported_from": {"format": form, "files": files}})

"""Calibrations that command-line options name: from a lake's day or state, from a file, from a log."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from jobs.terminal.summary import left_out as tell_damage
from jobs.terminal.vehicle_status import require_vehicle
from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, ExportedPair, FrameNames, reference_of
from pipeline.export.compare import Side, composed
from pipeline.export.files import from_ties, noted_frames, read_files, reference_of_rig, rig_poses
from pipeline.export.formats import FORMATS, format_named
from pipeline.export.lake import choose_pairs, pairs_of, priors_of_day, read_cameras, read_frame_ids, read_tf
from pipeline.export.tree import ESTIMATED_EDGES
from pipeline.ingest.containers.reader import open_log
from pipeline.ingest.messages.decoding import decode
from pipeline.rig.day_prior import read_transforms
from pipeline.rig.graph import BASE, EDGE_OF_PAIR, Edge, tie, words_of
from pipeline.rig.rig import Rig
from pipeline.rig.transform_tree import TransformTree
from pipeline.store.partitions import Lake
from schemas.versions import CODE_VERSION
from schemas.words import day_word

__all__ = ["FrameOptions", "at_prior", "pairs_to", "poses_in_use", "read_calibration", "read_sides"]


def read_calibration(
    location: str,
    vehicle: str,
    day: str | None,
    method: str,
    *,
    force: bool,
    frames: FrameOptions | None = None,
    own_frames: bool = False,
    is_signed: bool = False,
    mount: str | None = None,
) -> ExportedCalibration:
    """Read a day's records (without a day: the vehicle's state) for a file; ConfigError if there are none.

    `is_signed`: the state signed off last; `own_frames`: frames that no option names have the names of the logs.
    """
    lake = Lake.existing(location)
    try:
        found = pairs_of(lake, vehicle, day, method, is_signed=is_signed)
    except ConfigError:
        require_vehicle(lake, vehicle)  # names the vehicles of the lake, if this is none of them
        raise
    # Without a transform, a record was refused, or no prior is known.
    word = day_word("refused" if isinstance(p, str) else p.status for p in found.values())
    pairs, without = choose_pairs({words_of(edge): pair for edge, pair in found.items()}, force=force)
    details = [p.details for p in pairs.values()]
    days = {str(d) for detail in details for d in (*_listed(detail.get("days")), detail["day"])}
    names = (frames or FrameOptions()).names(read_frame_ids(lake, vehicle, days) if own_frames else None)
    edges = tuple(found)
    seen = sorted({sensor.name for edge in edges for sensor in edge.sensors if sensor.kind == "camera"})
    cameras = read_cameras(lake, vehicle, days, seen)
    tree = read_tf(lake, vehicle, days)
    T_base = None if mount is None else _mounting(mount, names, edges)
    on_base = {e for e in edges if BASE in e.sensors and words_of(e) in pairs}
    if T_base is None and not on_base:  # the car's own root, where its tf has one
        T_base = tree.lookup(names.of(BASE.name), names.of(reference_of(edges).name))
    source = f"record of {day}"
    if day is None:
        source = (
            f"{'signed-off ' * is_signed}state of {max((str(d['day']) for d in details), default='no day')}"
        )
    tell_damage(lake)
    return ExportedCalibration(
        vehicle, source, method, CODE_VERSION, pairs, edges, names, T_base, without, word, cameras, tree.edges
    )  # fmt: skip


def at_prior(calibration: ExportedCalibration, lake: Lake, day: str) -> ExportedCalibration:
    """The calibration with the priors of a day in place of its estimates."""
    found = priors_of_day(lake, calibration.vehicle, day, calibration.method)
    known = {name: pair for name, pair in found.items() if not isinstance(pair, str)}
    return replace(calibration, pairs=known, edges=tuple(pair.edge for pair in known.values()))


def pairs_to(found: ExportedCalibration, sensor: str) -> tuple[list[ExportedPair], str]:
    """Pairs on the chain from the reference to a sensor, and their statuses in words."""
    way = found.way(found.reference.name, sensor) or ()
    pairs = [pair for pair in found.pairs.values() if pair.edge in way]
    return pairs, ", ".join(sorted({pair.status for pair in pairs}))


def _listed(value: object) -> list[object]:
    return list(value) if isinstance(value, list) else []


def _mounting(text: str, names: FrameNames, edges: tuple[Edge, ...]) -> np.ndarray:
    """Read T_base_lidar of the reference sensor from log:FILE (/tf_static) or FORMAT:FILE."""
    name, colon, path = text.partition(":")
    if not colon:
        raise ConfigError(
            "command line", "mount", f"{text!r} is not log:FILE or FORMAT:FILE, as urdf:car.urdf"
        )
    if name == "log":
        tree = _logged(Path(path))
    else:
        form = format_named(name)
        if form.tree is None:
            raise ConfigError("command line", "mount", f"{name} files have no frames of a car")
        tree = form.tree(read_files([Path(path)]))
    base, reference = names.of(BASE.name), names.of(reference_of(edges).name)
    T = tree.lookup(base, reference)
    if T is None:
        frames = ", ".join(sorted({*tree.edges, *tree.edges.values()}))
        problem = f"no chain joins these frames; the file has: {frames or 'none'}"
        raise ConfigError(path, f"{base}, {reference}", problem)
    return T


def _logged(path: Path) -> TransformTree:
    """Read the transforms on /tf_static of a log in any container."""
    tree = TransformTree()
    with closing(open_log(path)) as log:
        for message in log.scan(["/tf_static"]):
            tree.add_message(decode(message.channel, message.data))
    return tree


def read_sides(
    texts: Sequence[str], location: str | None, vehicle: str | None, method: str, frames: FrameOptions
) -> list[Side]:
    """Read both sides of `boresight compare`: log:FILE, FORMAT:FILE[,FILE], a prior file, or [VEHICLE@]DAY[/METHOD].

    A file compared with the lake is read for the edges in the lake; two files are read for the edges of one
    camera, one lidar and one radar. METHOD may be "prior" (the prior of that day); DAY may be "state" (what
    to load tonight).

    Raises:
        ConfigError: a side has another form, or does not exist.
    """
    forms = [text.partition(":")[0] if ":" in text else "" for text in texts]
    forms = [form if form in {*FORMATS, "log"} else "" for form in forms]
    of_file = [bool(form) or text.endswith(".json") for form, text in zip(forms, texts, strict=True)]
    sides = {
        k: _side_of_lake(text, location, vehicle, method) for k, text in enumerate(texts) if not of_file[k]
    }
    known = tuple(pair.edge for side in sides.values() for pair in side.pairs.values()) or ESTIMATED_EDGES
    of_lake, logged = next(iter(sides.values()), None), {}
    if "log" in forms and location is not None and of_lake is not None:
        logged = read_frame_ids(Lake.existing(location), of_lake.vehicle, of_lake.days)
    for k, text in enumerate(texts):
        if of_file[k]:
            files = text.partition(":")[2] if forms[k] else text
            names = frames.names(logged) if forms[k] == "log" else frames.names_in(files.split(","))
            sides[k] = _side_of_files(text, forms[k], files, names, known)
    return [sides[k] for k in range(len(texts))]


def poses_in_use(
    text: str, location: str | None, vehicle: str, rig: Rig, frames: FrameOptions
) -> tuple[dict[str, np.ndarray], FrameNames]:
    """Read T_reference_sensor of a rig of many sensors from FORMAT:FILE[,FILE] or [VEHICLE@]DAY of a lake.

    Returns:
        Poses by sensor name (only sensors that the source has), and the frame names.

    Raises:
        ConfigError: the text has another form, or the source does not exist.
    """
    form, _, listed = text.partition(":")
    base = {} if rig.base is None else {"base": rig.base}
    if form in FORMATS:
        files = [Path(file) for file in listed.split(",")]
        names = frames.names(base | noted_frames(files))
        return rig_poses(format_named(form), read_files(files), names, rig), names
    owner, _, day = text.rpartition("@")
    if location is None:
        problem = f'{text!r} is neither FORMAT:FILE nor .json; a day of a lake, or "state", needs --lake'
        raise ConfigError("command line", "--calibration", problem)
    found = pairs_of(Lake.existing(location), owner or vehicle, None if day == "state" else day, "joint")
    reference = reference_of_rig(rig)
    wanted = {tie(n, reference) for n in rig.nodes if n != reference}
    if not found.keys() & wanted:
        raise ConfigError("command line", "--calibration", f"{text}: no poses relative to {reference.name}")
    known = {edge: pair.T for edge, pair in found.items() if edge in wanted and not isinstance(pair, str)}
    return from_ties(known, reference), frames.names(base)


def _side_of_files(text: str, form: str, files: str, names: FrameNames, edges: tuple[Edge, ...]) -> Side:
    if form == "log":
        tree = _logged(Path(files))
        chains = {words_of(e): tree.lookup(names.of(e.parent.name), names.of(e.child.name)) for e in edges}
        found = {words: T for words, T in chains.items() if T is not None}
    elif form:
        found = format_named(form).pairs(read_files([Path(f) for f in files.split(",")]), names, edges)
    else:
        found = read_transforms(Path(text))
    of = {words_of(edge): edge for edge in (*EDGE_OF_PAIR.values(), *edges)}
    pairs = {pair: ExportedPair(of[pair], T, status="given") for pair, T in found.items()}
    return Side(text, composed(pairs))


def _side_of_lake(text: str, location: str | None, vehicle: str | None, method: str) -> Side:
    owner, at, rest = text.rpartition("@")
    owner = owner if at else (vehicle or "")
    day, _, named = rest.partition("/")
    if location is None or not owner:
        problem = f"{text!r} is neither FORMAT:FILE nor .json; a day of a lake needs --lake and --vehicle"
        raise ConfigError("command line", "A, B", problem)
    lake = Lake.existing(location)
    by, of_day = named or method, None if day == "state" else day
    if named == "prior":
        found = priors_of_day(lake, owner, day, method)
    else:
        found = {words_of(edge): pair for edge, pair in pairs_of(lake, owner, of_day, by).items()}
    pairs, missing = choose_pairs(found, force=True)
    listed = {str(d) for pair in pairs.values() for d in _listed(pair.details.get("days"))}
    days = set() if named == "prior" else listed if day == "state" else {day}
    return Side(f"{owner} {rest}", pairs, owner, frozenset(days), missing)


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
    base: Annotated[str | None, Parameter(name="--base-frame", help="frame of the car, for --mount")] = None
    frame: Annotated[
        tuple[str, ...],
        Parameter(name="--frame", help="SENSOR=NAME: frame of any sensor; repeat for several", negative=()),
    ] = ()

    def names(self, known: Mapping[str, str] | None = None) -> FrameNames:
        """Frame names for the pipeline; `known` has names for frames without an option; else ConfigError."""
        asked = {s: n for s in _KINDS if (n := getattr(self, s)) is not None}
        for text in self.frame:
            sensor, equals, name = text.partition("=")
            if not (sensor and equals and name):
                raise ConfigError("command line", "frame", f"{text!r} is not SENSOR=NAME, as front=cam_front")
            asked[sensor] = name
        return FrameNames({**(known or {}), **asked})

    def names_in(self, files: Iterable[str | Path]) -> FrameNames:
        """Frame names for reading files: from options, else from an export's notes in or beside them."""
        return self.names(noted_frames([Path(file) for file in files]))

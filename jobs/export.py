"""`boresight export`: a calibration as a file; JSON Schemas of the tables; a trained network as ONNX."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from jobs.calibration_sources import FrameOptions, at_prior, read_calibration
from jobs.extras import require
from jobs.terminal.logging import logger
from jobs.terminal.summary import exit_code, print_summary, progress_reporter
from pipeline.core.errors import ConfigError
from pipeline.export.calibration import USABLE, ExportedCalibration, written_pairs
from pipeline.export.files import updated_file, write_files, written_files
from pipeline.export.formats import format_named
from pipeline.export.lake import read_scenes
from pipeline.export.provenance import not_certified, used_lines, warnings_of
from pipeline.store.atomic_write import atomic_write
from pipeline.store.partitions import Lake, Partition
from schemas.versions import write_json_schemas

__all__ = ["export"]

NOTHING_CERTIFIED = 4  # exit code: a file was written, or nothing could be, and nothing in it is certified
What = Literal[
    "schemas", "onnx", "ros2", "tf-static", "urdf", "xacro", "autoware", "kitti", "nuscenes", "t4", "kalibr", "opencv",
    "foxglove",
]  # fmt: skip


def export(
    what: What,
    *,
    out: Path,
    lake: str | None = None,
    vehicle: str | None = None,
    day: str | None = None,
    method: str = "joint",
    signed_off: bool = False,
    force: bool = False,
    mount: str | None = None,
    update: Path | None = None,
    frames: FrameOptions | None = None,
    generic_frames: bool = False,
    most_frames: Annotated[int, Parameter(validator=Number(gte=1))] = 100,
    sensor: Annotated[tuple[str, ...], Parameter(negative=())] = (),
    run: Path | None = None,
    notes: Path | None = None,
) -> int:
    """Write a file for other programs: a calibration in one of many formats, JSON Schemas, or a network.

    For frames of many days with their calibration: `boresight export frames --help`.

    A calibration is a vehicle's state, or with --day the records of that day. In a state, a sensor without usable
    days is at its prior; of a day, held and refused pairs are left out. The file and the summary have the reasons.

    Exit codes: 0 all that the vehicle has is current (of a day: accepted); 3 something is at the prior, held or left
    out, or a network is not fit for use; 4 nothing is certified.

    Args:
        what: format of a calibration; or "foxglove", an MCAP file of a day's drive with its calibration, for
            viewers; or "schemas", a JSON Schema (2020-12) of the rows of each table; or "onnx", a trained
            network with its card.
        out: folder to write into, created if missing; for formats of a single file, that file.
        lake: folder of the tables.
        vehicle: vehicle id.
        day: YYYY-MM-DD: export the records of this day; default: the vehicle's state.
        method: calibration method.
        signed_off: write the state that was signed off last (`boresight state --sign-off`) instead of tonight's.
        force: with --day, write held pairs too, marked as held; the exit code is that without --force.
        mount: pose of the reference lidar on the car (from --base-frame to the lidar's frame): log:FILE (its
            /tf_static) or FORMAT:FILE, as in urdf:car.urdf; default: from the car's logs, where their /tf_static
            has the base frame; else the lidar is the root of the tree.
        update: for "autoware": your sensor_kit_calibration.yaml; --out is a copy of it with new numbers for
            the calibrated sensors.
        frames: frame names.
        generic_frames: name frames after the sensors (camera, lidar, radar) instead of the frames in the
            car's logs (autoware always does).
        most_frames: for "foxglove", which shows the drive of --day: maximum number of frames, evenly spaced.
        sensor: for "foxglove": only this sensor; repeat for several; default: all.
        run: folder written by `boresight train`; required for "onnx".
        notes: JSON object for the card: measurements, description of the data.
    """
    if what == "schemas":
        print_summary("export", "done", what=what, outputs=write_json_schemas(out))
        return 0
    if what == "onnx":
        return _export_onnx(out, run, notes)
    if lake is None or vehicle is None:
        raise ConfigError("command line", "lake, vehicle", "a calibration needs --lake and --vehicle")
    if signed_off and day is not None:
        raise ConfigError("command line", "signed-off", "only a state is signed off: leave out --day")
    if force and day is None:
        problem = "a state has no held pairs: leave out --force, which goes with --day"
        raise ConfigError("command line", "force", problem)
    # Autoware's sensor kit has the camera's link, while logs name its optical frame.
    own_frames = not (generic_frames or what == "autoware")
    calibration = read_calibration(
        lake, vehicle, day, method, force=force, frames=frames,
        own_frames=own_frames, is_signed=signed_off, mount=mount,
    )  # fmt: skip
    outputs: list[Path] = []
    if what == "foxglove":
        if day is None:
            raise ConfigError("command line", "day", "foxglove shows a day's drive: give --day")
        if written_pairs(calibration):
            outputs = _export_drive(calibration, lake, day, out, most_frames, sensor)
    elif written_pairs(calibration):
        form = format_named(what)
        files = (
            updated_file(form, calibration, update, out) if update else written_files(form, calibration, out)
        )
        write_files(files)
        outputs = list(files)
    return _tell(what, calibration, outputs)


def _tell(what: str, calibration: ExportedCalibration, outputs: list[Path]) -> int:
    """Log what of each pair is used and each warning, print the summary and return the exit code."""
    doubts, written = not_certified(calibration), written_pairs(calibration)
    for words in used_lines(calibration):
        logger().info(words, vehicle=calibration.vehicle, source=calibration.source)
    for words in warnings_of(calibration):
        logger().warning(words, vehicle=calibration.vehicle, source=calibration.source)
    usable = (pair for name in written if (pair := calibration.pairs[name]).status in USABLE)
    certified = any(pair.certified for pair in usable)
    word = calibration.word
    status = "uncertified" if not certified and word in ("done", "partly") else word
    told = {"vehicle": calibration.vehicle, "source": calibration.source, "pairs": written}
    print_summary("export", status, what=what, **told, not_certified=doubts, outputs=outputs)
    return NOTHING_CERTIFIED if not certified else 0 if word == "done" else 3


def _export_onnx(out: Path, run: Path | None, notes: Path | None) -> int:
    """Write a network with its card; held, with exit code 3, is one that is not fit for use."""
    if run is None or not run.is_dir():
        raise ConfigError("command line", "run", "onnx needs --run FOLDER, written by `boresight train`")
    if out.suffix != ".onnx":
        raise ConfigError("command line", "out", f"{out} must end in .onnx")

    require("train")
    from pipeline.learn.export.onnx_file import card_of_run, export_onnx
    from pipeline.learn.infer.onnx_networks import UNFIT
    from pipeline.learn.train.run import network_of_run

    with progress_reporter("export onnx"):
        card = card_of_run(run, notes)
        export_onnx(network_of_run(run), out, card)
    unfit = next((str(limit) for limit in card["limits"] if str(limit).startswith(UNFIT)), "")
    if unfit:
        logger().warning(unfit, run=str(run))
    ended, paths = "held" if unfit else "done", [out, out.with_suffix(".json"), out.with_suffix(".md")]
    print_summary("export", ended, what="onnx", reason=unfit, outputs=paths, bytes=out.stat().st_size)
    return exit_code([ended])


def _export_drive(
    calibration: ExportedCalibration,
    location: str,
    day: str,
    out: Path,
    most_frames: int,
    sensors: Sequence[str],
) -> list[Path]:
    """Write the MCAP file `out` and a viewer layout next to it.

    Raises:
        MissingExtraError: foxglove-sdk is not installed.
        ConfigError: `out` does not end in .mcap, a sensor does not exist, or the day has no frames.
    """
    require("viz")
    if out.suffix != ".mcap":
        raise ConfigError("command line", "out", f"{out} must end in .mcap")
    from pipeline.export.foxglove import layout_of, write_foxglove

    there = {s.name: s for s in calibration.sensors}
    if unknown := [name for name in sensors if name not in there]:
        problem = f"no {', '.join(unknown)}: the rig has {', '.join(there)}"
        raise ConfigError("command line", "sensor", problem)
    shown = [there[name] for name in sensors or there]
    lake, reference = Lake.existing(location), calibration.reference
    partition, layout = Partition(calibration.vehicle, day), out.with_suffix(".layout.json")
    beside = {"lidar": reference.name} if reference.kind == "lidar" else {}
    scenes = {
        s: read_scenes(
            lake, partition, most_frames, {s.kind: s.name} | (beside if s.kind == "camera" else {})
        )
        for s in shown
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    with progress_reporter("export foxglove"), atomic_write(out) as stream:
        write_foxglove(stream, calibration, at_prior(calibration, lake, day), scenes)
    with atomic_write(layout) as stream:
        stream.write(layout_of(shown, reference.name, calibration.names.of(reference.name)))
    return [out, layout]

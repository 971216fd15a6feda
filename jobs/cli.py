"""The command `boresight`: which job lies behind which word, and how every job ends.

A job is a function of its own file that returns an exit code; it is imported when its command is called.
Exit codes: 0 done or up to date; 1 failed, a retry may help; 2 usage or configuration; 3 done, but something
was held or refused; 130 and 143 after SIGINT and SIGTERM.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from cyclopts import App, CycloptsError

from jobs.terminal.logging import configure, logger
from jobs.terminal.summary import print_summary
from pipeline.errors import BoresightError
from pipeline.store.atomic_write import NO_SPACE

__all__ = ["COMMANDS", "app", "main"]

FAILED, USAGE, INTERRUPTED, TERMINATED = 1, 2, 130, 143
_OUTPUTS = ("--out", "--page", "--report")

# Command -> where its function is, and what `boresight --help` says of it.
COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("jobs.demo:demo", "Synthetic fleet to HTML report, in minutes: what all of this does."),
    "init": ("jobs.init:init", "A fleet.toml out of the logs themselves, with comments for what is missing."),
    "check": ("jobs.check:check", "Can these logs be calibrated, and which degrees of freedom?"),
    "verify": (
        "jobs.verify:verify",
        "Is the calibration that the car uses now still right? One log's answer.",
    ),
    "nightly": (
        "jobs.nightly:nightly",
        "Ingest, perceive, calibrate and audit all vehicle-days of a pattern.",
    ),
    "ingest": ("jobs.ingest:ingest", "Logs of one vehicle-day to the table frames."),
    "perceive": ("jobs.perceive:perceive", "Frames of one vehicle-day to the table observations."),
    "calibrate": ("jobs.calibrate:calibrate", "Observations of one vehicle-day to calibration records."),
    "prepare": ("jobs.prepare:prepare", "Frames and observations of many vehicle-days to training data."),
    "train": ("jobs.train:train", "A network from training data, without any ground truth."),
    "train-radar-drivable": (
        "jobs.train_radar_drivable:train_radar_drivable",
        "A small network for the radar's drivable area, taught by the lidar.",
    ),
    "train-lidar-semantics": (
        "jobs.train_lidar_semantics:train_lidar_semantics",
        "A small range-image network for lidar points, taught by the camera.",
    ),
    "models": ("jobs.models:models", "The networks that ship, and those that `models fetch` downloads."),
    "models list": ("jobs.models:models", "The same as `models`."),
    "models fetch": (
        "jobs.models:fetch",
        "Download a segmenter and a detector for cameras without labels; licence and sha256 are shown.",
    ),
    "audit": ("jobs.audit:audit", "Control charts over days: which sensor moved, and since when."),
    "service": ("jobs.service:service", "Note a repair, a re-mount or a release: charts begin anew."),
    "state": ("jobs.state:state", "What each vehicle should load tonight, with its sigma."),
    "report": ("jobs.report:report", "HTML pages of vehicle-days and of the fleet."),
    "show": ("jobs.show:show", "What a lake holds, for people or as JSON."),
    "status": ("jobs.status:status", "What is done, held, refused, failed or missing, and why."),
    "gc": ("jobs.gc:gc", "Take images, and pages that show them, out of a lake after their time."),
    "export": (
        "jobs.export:export",
        "Write a calibration for ROS 2, Autoware, KITTI, ...; the tables' JSON Schema; a network as ONNX.",
    ),
    "export frames": (
        "jobs.export_frames:export_frames",
        "Frames of many days with the calibration, for networks: WebDataset, Parquet, KITTI, nuScenes.",
    ),
    "import": ("jobs.import_prior:import_prior", "Calibration files of other programs to a prior file."),
    "compare": ("jobs.compare:compare", "Two calibrations, axis by axis: records, days, methods, files."),
    "migrate": ("jobs.migrate:migrate", "A lake of an older release to the tables of this one."),
    "repair": ("jobs.repair:repair", "A lake with a damaged log or lost files: what is left, made whole."),
    "convert": (
        "jobs.convert:convert",
        "Folders of public data sets (nuScenes, View-of-Delft, KITTI) to logs.",
    ),
    "simulate": ("jobs.simulate:simulate", "Logs of a synthetic fleet, its truth in a file of its own."),
    "evaluate": ("jobs.evaluate:evaluate", "Compare records with a known truth or a reflector recording."),
}


def _version() -> str:
    from schemas.versions import CODE_VERSION  # brings pyarrow

    return CODE_VERSION


app = App(
    name="boresight",
    help="Recalibrates a fleet's camera, lidar and radar overnight from ordinary driving logs.",
    version=_version,
    help_format="plaintext",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)
for _name, (_path, _help) in COMMANDS.items():
    app.command(_path, name=_name, help=_help)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    tokens = list(sys.argv[1:] if argv is None else argv)
    if " ".join(tokens[:2]) in COMMANDS:  # a command of two words
        tokens[:2] = [" ".join(tokens[:2])]
    command = next((t for t in tokens if t in COMMANDS), "boresight")
    signal.signal(signal.SIGTERM, _stop)
    configure()
    try:
        result: Any = app(tokens, exit_on_error=False, print_error=False)
    except CycloptsError as err:
        code, reason = USAGE, str(err)
    except BoresightError as err:
        code, reason = err.exit_code, str(err)
    except KeyboardInterrupt:
        code, reason = INTERRUPTED, "interrupted"
    except SystemExit as err:
        if err.code != TERMINATED:
            raise
        code, reason = TERMINATED, "terminated"
    except Exception as err:  # noqa: BLE001 - the last resort: one line for people, the traceback in the log
        logger().error("unexpected error", command=command, exc_info=True)
        code, reason = FAILED, f"{type(err).__name__}: {err}{_output(err, tokens)}"
    else:
        return result if isinstance(result, int) else 0
    return _end(command, reason, code)


def _output(err: Exception, tokens: Sequence[str]) -> str:
    """What the command writes to, for an error for want of space without a path: those of lakes have theirs."""
    if not isinstance(err, OSError) or err.errno not in NO_SPACE or err.filename is not None:
        return ""
    parts = [part for token in tokens for part in token.split("=", 1)]
    return "".join(f", writing to {path}" for option, path in pairwise(parts) if option in _OUTPUTS)


def _stop(signum: int, _frame: Any) -> None:
    """Unwind through every `finally`: nothing stays half-written. A second signal cannot cut that short."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(128 + signum)


def _end(command: str, reason: str, code: int) -> int:
    logger().error(reason, command=command, exit_code=code)
    if command != "show":  # its stdout holds records and nothing else
        status = {3: "refused", INTERRUPTED: "stopped", TERMINATED: "stopped"}.get(code, "failed")
        print_summary(command, status, reason=reason, exit_code=code)
    return code


if __name__ == "__main__":
    sys.exit(main())

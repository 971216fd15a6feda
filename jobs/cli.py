"""The command `boresight`: the table of its commands, and exit codes.

Each command is a function in a file of its own. It is imported when called, and returns an exit code.
Exit codes: 0 done or up to date; 1 failed, a retry may help; 2 usage or configuration; 3 done, something was held
or refused; 4 nothing certified (export), wrong (verify); 5 inconclusive (verify); 130, 143 after SIGINT, SIGTERM.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, TextIO

from cyclopts import App, CycloptsError, UnusedCliTokensError

from jobs.terminal.logging import configure, logger
from jobs.terminal.summary import is_terminal, print_summary
from pipeline.core.errors import BoresightError
from pipeline.store.atomic_write import NO_SPACE

__all__ = ["COMMANDS", "app", "main"]

FAILED, USAGE, INTERRUPTED, TERMINATED = 1, 2, 130, 143
_UNQUOTED = " Put a pattern of --logs in quotes, else the shell replaces it by paths."
_OUTPUTS = ("--out", "--page", "--report")

# Command -> its line in `boresight --help`.
_HELP = {
    "demo": "Simulate a small fleet, calibrate it and write an HTML report, in minutes.",
    "init": "Write a fleet.toml from logs, with comments for what is missing.",
    "check": "Check whether logs can be calibrated, and in which degrees of freedom.",
    "verify": "Check the calibration that a car uses now against one or more logs.",
    "nightly": "Ingest, perceive, calibrate and audit all vehicle-days of a fleet.",
    "ingest": "Read and synchronise the logs of one vehicle-day.",
    "perceive": "Find semantics, objects, edges and motion in one vehicle-day.",
    "calibrate": "Estimate extrinsics of one vehicle-day and record them.",
    "prepare": "Make training data from many vehicle-days.",
    "train": "Train a network without ground truth: calibration, lidar semantics, drivable area.",
    "models": "List the included networks, and download others for cameras without labels.",
    "audit": "Find sensors that moved, by control charts over days.",
    "service": "Record a repair, a re-mount or a software release: charts restart.",
    "state": "Show the calibration that each vehicle should load tonight, with sigmas.",
    "report": "Write HTML pages of vehicle-days and of the fleet.",
    "show": "Show the rows of a lake's tables, as a table or as JSON.",
    "view": "Show one vehicle-day in 3D, before and after its calibration.",
    "status": "Show which vehicle-days are done, held, refused, failed or missing, and why.",
    "gc": "Delete old images, and pages that show them, from a lake.",
    "export": "Write a calibration (ROS 2, Autoware, KITTI, ...), frames for training, JSON Schemas or a network.",
    "export frames": "Write frames of many days with calibration: Parquet, nuScenes.",
    "import": "Convert calibration files of other programs to a prior file.",
    "compare": "Compare two calibrations axis by axis: records, days, methods, files.",
    "repair": "Repair a lake with a damaged log or lost files.",
    "convert": "Convert public data sets (nuScenes, View-of-Delft, KITTI) to logs.",
    "simulate": "Write logs of a simulated fleet, and its true extrinsics.",
    "evaluate": "Compare records with true extrinsics or a reflector recording.",
}
# Where a command has another name than its module or its function.
_ELSEWHERE = {
    "import": "jobs.import_prior:import_prior", "perceive": "jobs.ingest:perceive", "gc": "jobs.upkeep:gc",
    "repair": "jobs.upkeep:repair",
}  # fmt: skip
# Command -> its function and its line of help.
COMMANDS: dict[str, tuple[str, str]] = {
    name: (_ELSEWHERE.get(name, "jobs.{0}:{0}".format(name.replace(" ", "_"))), text)
    for name, text in _HELP.items()
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
    app.command(_path, name=_name, help=_help, show=" " not in _name)  # two words: in the help of the first


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    tokens = list(sys.argv[1:] if argv is None else argv)
    if " ".join(tokens[:2]) in COMMANDS:  # a command of two words
        tokens[:2] = [" ".join(tokens[:2])]
    command = next((t for t in tokens if t in COMMANDS), "boresight")
    signal.signal(signal.SIGTERM, _stop)
    configure()
    try:
        if command in COMMANDS and {"--help", "-h"} & set(tokens):
            app[command].help = None  # so the function's own text is shown; the line above is for the list
        result: Any = app(tokens, exit_on_error=False, print_error=False)
    except CycloptsError as err:
        code, reason = USAGE, f"{err}{_UNQUOTED if isinstance(err, UnusedCliTokensError) else ''}"
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
    """The output path of the command, for an error that the disk is full and that names no path."""
    if not isinstance(err, OSError) or err.errno not in NO_SPACE or err.filename is not None:
        return ""
    parts = [part for token in tokens for part in token.split("=", 1)]
    return "".join(f", writing to {path}" for option, path in pairwise(parts) if option in _OUTPUTS)


def _stop(signum: int, _frame: Any) -> None:
    """Exit through every `finally`: no file is left half-written. A second signal cannot interrupt that."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(128 + signum)


def _end(command: str, reason: str, code: int) -> int:
    """Print the error: a line on stderr, the summary on stdout, and one of the two where both go to one place."""
    is_shown_once = _is_one_place(sys.stdout, sys.stderr)
    has_summary = command != "show"  # stdout of `show` contains only records
    if not (is_shown_once and has_summary) or is_terminal():
        logger().error(reason, command=command, exit_code=code)
    if has_summary and not (is_shown_once and is_terminal()):
        status = {3: "refused", INTERRUPTED: "stopped", TERMINATED: "stopped"}.get(code, "failed")
        print_summary(command, status, reason=reason, exit_code=code)
    return code


def _is_one_place(a: TextIO, b: TextIO) -> bool:
    """Whether streams are the same terminal, file or pipe."""
    try:
        return os.path.sameopenfile(a.fileno(), b.fileno())
    except (OSError, ValueError):  # not a file, as in tests
        return False


if __name__ == "__main__":
    sys.exit(main())

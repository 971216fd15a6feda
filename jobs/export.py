"""`boresight export`: the tables' contracts as JSON Schema, or a trained network as ONNX."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

__all__ = ["export"]


def export(
    what: Literal["schemas", "onnx"], *, out: Path, run: Path | None = None, notes: Path | None = None
) -> int:
    """Write what others read without Boresight.

    Args:
        what: "schemas", one JSON Schema (2020-12) of a row per table; or "onnx", a trained network with its card.
        out: folder to write schemas into, made where it is missing; or the .onnx file, its card beside it.
        run: folder of `boresight train`; needed for "onnx".
        notes: JSON object for the card: what was measured, what the data was.
    """
    from jobs.terminal.summary import print_summary

    if what == "schemas":
        from schemas.versions import write_json_schemas

        print_summary("export", "done", what=what, outputs=write_json_schemas(out))
        return 0
    paths = _export_onnx(out, run, notes)
    print_summary("export", "done", what=what, outputs=paths, bytes=out.stat().st_size)
    return 0


def _export_onnx(out: Path, run: Path | None, notes: Path | None) -> list[Path]:
    from pipeline.errors import ConfigError

    if run is None or not run.is_dir():
        raise ConfigError("command line", "run", "onnx needs --run FOLDER, as `boresight train` left it")
    if out.suffix != ".onnx":
        raise ConfigError("command line", "out", f"{out} must end in .onnx")
    from jobs.extras import require

    require("train")
    from pipeline.learn.export.model_card import card_of_run
    from pipeline.learn.export.onnx_file import export_onnx
    from pipeline.learn.train.run_state import network_of_run

    export_onnx(network_of_run(run), out, card_of_run(run, notes))
    return [out, out.with_suffix(".json"), out.with_suffix(".md")]

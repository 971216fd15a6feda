"""`boresight evaluate`: errors of calibration records against true extrinsics or picked reflectors."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

from jobs.calibrate import parse_pair
from jobs.terminal.summary import print_summary, progress_reporter
from pipeline.core.errors import ConfigError
from pipeline.evaluate.comparison import compare_runs
from pipeline.evaluate.recording import ReflectorFiles
from pipeline.evaluate.table import as_markdown, as_parquet, table_rows
from pipeline.report.evaluation import page_of_runs
from pipeline.report.page import write_page
from pipeline.rig.targets import ComparedRun
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord

__all__ = ["evaluate"]


def evaluate(
    *,
    lake: str,
    truth: Path | None = None,
    reflectors: Path | None = None,
    recording_lake: str | None = None,
    recording_day: str | None = None,
    method: str | None = None,
    truth_sigma: str = "0,0",
    out: Path | None = None,
) -> int:
    """Compute errors of records against true extrinsics or a corner-reflector recording, as in the paper.

    Errors are in azimuth, elevation and range at three reflectors, with the paper's printed numbers for
    comparison.

    Args:
        lake: folder of the tables.
        truth: JSON with T_camera_lidar and T_lidar_radar (4x4), or a folder with VEHICLE/DAY.json.
        reflectors: instead of --truth, JSON of reflector positions picked in each sensor's data, for one
            vehicle and day (written by `simulate --reflectors`; {"camera": {...}, "targets": [{"pixel",
            "lidar_m", "radar_m", ...}]}, described in pipeline/evaluate/recording.py), or a folder with
            VEHICLE/DAY.json.
        recording_lake: lake with the ingested reflector recording: lidar and radar positions are then
            measured in its frames near the picks; camera pixels stay as picked. Default: --lake if
            --recording-day is given.
        recording_day: day of the ingested recording; default: the day of the picks. A lake has one partition
            per vehicle-day: give the recording another day or another lake, otherwise it replaces the drives.
        method: only records of this method.
        truth_sigma: ROT_DEG,TRANS_M: 1-sigma uncertainty of --truth, for errors in units of sigma.
        out: FILE.md, FILE.parquet, FILE.html (a page with the paper's figures for these days), or a folder
            for all of them as table_1.*; the tables are printed on stderr in any case.
    """
    if (truth is None) == (reflectors is None):
        raise ConfigError("command line", "truth", "give either --truth or --reflectors")
    if truth is not None and (recording_lake or recording_day):
        raise ConfigError("command line", "recording-lake", "a reflector recording needs --reflectors")
    if out is not None and not out.is_dir() and out.suffix not in ("", ".md", ".parquet", ".html"):
        problem = f"{out.name} is neither a folder nor one of .md, .parquet, .html"
        raise ConfigError("command line", "out", problem)
    tables = Lake.existing(lake)
    records = [r for r in read_records(tables, CALIBRATIONS, CalibrationRecord) if method in (None, r.method)]
    recording = (recording_lake or lake, recording_day) if recording_lake or recording_day else None
    files = ReflectorFiles(reflectors, recording)
    rotation_deg, translation_m = parse_pair(truth_sigma, "truth-sigma")
    with progress_reporter("evaluate") as progress:
        progress(0, len(records), "records")
        compared, counts = compare_runs(records, truth, files, (math.radians(rotation_deg), translation_m))
    notes = files.notes()
    comparisons = [c.comparison for c in compared]
    sys.stderr.write("\n".join(as_markdown(table_rows(comparisons), comparisons, notes).values()))
    if out is not None:
        with progress_reporter("evaluate") as progress:
            progress(0, 0, "tables and figures")
            _write(out, compared, notes, tables)
    print_summary(
        "evaluate", "done" if compared else "refused", runs=len(compared), **counts, positions=notes, out=out
    )
    return 0 if compared else 3


def _write(out: Path, compared: Sequence[ComparedRun], notes: Sequence[str], lake: Lake) -> None:
    """Write the file of --out by its suffix; a folder, or a path without suffix, gets all of them."""
    comparisons = [c.comparison for c in compared]
    rows = table_rows(comparisons)
    texts = as_markdown(rows, comparisons, notes)
    out.parent.mkdir(parents=True, exist_ok=True)
    kind = "" if out.is_dir() else out.suffix
    if kind == ".parquet":
        out.write_bytes(as_parquet(rows, notes))
    elif kind == ".html":
        write_page(out, page_of_runs(lake, compared, texts))
    elif kind == ".md":
        out.write_text("\n".join(texts.values()))
    else:
        out.mkdir(parents=True, exist_ok=True)
        for title, text in texts.items():
            (out / f"{title.lower().replace(' data', '').replace(' ', '_')}.md").write_text(text)
        (out / "table_1.parquet").write_bytes(as_parquet(rows, notes))
        write_page(out / "table_1.html", page_of_runs(lake, compared, texts))

"""`boresight evaluate`: calibration records against a known truth or picked reflectors, as the paper's Table 1."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from pipeline.verify.targets import Picks
    from schemas.calibrations import CalibrationRecord

__all__ = ["evaluate"]


def evaluate(
    *,
    lake: str,
    truth: Path | None = None,
    reflectors: Path | None = None,
    method: str | None = None,
    truth_sigma: str = "0,0",
    out: Path | None = None,
) -> int:
    """Measure records by the paper's metric: azimuth, elevation and range errors at three reflectors.

    Args:
        lake: folder of the tables.
        truth: JSON with T_camera_lidar and T_lidar_radar (4x4), or a folder with VEHICLE/DAY.json.
        reflectors: JSON of reflector positions as picked in each sensor's data, instead of a truth:
            {"camera": {model, K, D, width_px, height_px}, "targets": [{"pixel": [u, v], "lidar_m": [x, y, z],
            "radar_m": [x, y, z]}]}.
        method: only this method's records.
        truth_sigma: ROT_DEG,TRANS_M: how well the truth itself is known, for the errors in sigmas.
        out: Markdown file to write; the table goes to stderr in any case.
    """
    import math
    import sys

    from jobs.calibrate import parse_pair
    from jobs.summary import print_summary
    from pipeline.errors import ConfigError
    from pipeline.store.partitions import Lake
    from pipeline.store.tables import read_records
    from pipeline.verify.evaluation import compare, current_runs, table_1
    from schemas.calibrations import CALIBRATIONS, CalibrationRecord

    if (truth is None) == (reflectors is None):
        raise ConfigError("command line", "truth", "give either --truth or --reflectors")
    records = [
        r for r in read_records(Lake.at(lake), CALIBRATIONS, CalibrationRecord) if method in (None, r.method)
    ]
    picks = _read_picks(reflectors) if reflectors else None
    known_deg, known_m = parse_pair(truth_sigma, "truth-sigma")
    compared, refused, unknown = [], 0, 0
    for run in current_runs(records):
        known = None if truth is None else _truth_of(truth, next(iter(run.values())))
        if known is None and picks is None:
            unknown += 1
            continue
        comparison = compare(run, known, picks, (math.radians(known_deg), known_m))
        if comparison is None:
            refused += 1
        else:
            compared.append(comparison)
    text = table_1(compared)
    sys.stderr.write(text)
    if out is not None:
        out.write_text(text)
    status = "done" if compared else "refused"
    print_summary(
        "evaluate", status, runs=len(compared), refused_runs=refused, runs_without_truth=unknown, out=out
    )
    return 0 if compared else 3


def _truth_of(truth: Path, record: CalibrationRecord) -> dict[str, np.ndarray] | None:
    from pipeline.prior import read_transforms

    path = truth / record.vehicle / f"{record.day}.json" if truth.is_dir() else truth
    if truth.is_dir() and not path.exists():
        return None
    return read_transforms(path)


def _read_picks(path: Path) -> Picks:
    import json

    import numpy as np

    from pipeline.errors import ConfigError
    from pipeline.geometry.cameras import Camera
    from pipeline.verify.targets import Picks

    try:
        content = json.loads(path.read_text())
        c, targets = content["camera"], content["targets"]
        camera = Camera(
            c["model"],
            np.array(c["K"], float),
            np.array(c["D"], float),
            int(c["width_px"]),
            int(c["height_px"]),
        )
        pixels, lidar_m, radar_m = (
            np.array([t[key] for t in targets], float) for key in ("pixel", "lidar_m", "radar_m")
        )
    except (OSError, ValueError, KeyError, TypeError) as err:
        raise ConfigError(str(path), "", f"no readable reflector file: {err!r}") from err
    if not targets or [a.shape[1:] for a in (pixels, lidar_m, radar_m)] != [(2,), (3,), (3,)]:
        raise ConfigError(
            str(path), "targets", "each needs pixel [u, v], lidar_m [x, y, z] and radar_m [x, y, z]"
        )
    return Picks(pixels, lidar_m, radar_m, camera)
